"""The simulated counterpart of a recorded robot: its building, drive, scanner and wheels."""

from typing import NamedTuple

import jax
import numpy as np

from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import dead_reckoning, increments, relative
from jaxslam.io import world_grid
from jaxslam.mapping.occupancy import occupancy_map
from jaxslam.simulation.given_poses import simulate_at_poses
from jaxslam.simulation.life import Life
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.scanner_presets import preset
from jaxslam.simulation.scanners import Scanner, pieces
from jaxslam.simulation.worlds import World

RESOLUTION = 0.05  # [m] of the map whose outline the walls are
WHEEL_BASE = 0.4  # [m]; no log states it
FINE_STD, COARSE_STD = 0.004, 0.016  # [m] as the scans show on straight walls
COARSE_LOGS = ("aces",)
"""Logs whose ranges are about multiples of 5 cm; the others are of SICK's LMS-200."""
TURN_TIME = 1 / 75
"""[s] of the mirror of the LMS-200 (driver ros-drivers/sicktoolbox_wrapper, sicklms.cpp), which
makes a scan of half a degree of two turns; of the other scanner nothing is known."""
SPEED_SPAN = 0.2  # [s] before and after a scan, over which the odometry gives the velocity
MIN_TURN = 0.05  # [m] least motion that an error of the heading is divided by
HALF_NORMAL = 1.4826  # standard deviation of a Gaussian per median of its modulus


class Wheels(NamedTuple):
    """How the odometry of a log differs from the motion; true = factors times reported + noise.

    Attributes:
        distance: Factor on a distance.
        turn: Factor on a turn.
        turn_per_metre: [rad / m] that the heading turns beside.
        turn_std: [rad / sqrt(m)] standard deviation of the turn over a metre, robust.
        outliers: Share of the turns more than three standard deviations off.
    """

    distance: float
    turn: float
    turn_per_metre: float
    turn_std: float
    outliers: float


class Counterpart(NamedTuple):
    """What is simulated in place of a recorded drive of T scans.

    Attributes:
        lidar: The scanner as the reader of the log has it.
        robot: Scanner and wheels.
        world: The walls.
        poses: (T, 3) [m, m, rad] true poses.
        times: (T,) [s] of the log.
        velocities: (T, 3) [m/s, m/s, rad/s] of the scanner.
    """

    lidar: Lidar
    robot: Robot
    world: World
    poses: np.ndarray
    times: np.ndarray
    velocities: np.ndarray


def scanner_of(name: str, lidar: Lidar) -> Scanner:
    """The scanner of a log: directions as in the log, the rest of its kind."""
    own = preset("LMS-200")._replace(
        num_beams=lidar.num_beams,
        angle_min=lidar.angle_min,
        angle_increment=lidar.angle_increment,
        range_max=lidar.range_max,
        range_noise=pieces((0.0, FINE_STD, 0.0)),
        range_resolution=0.01,
        turn_time=TURN_TIME,
        num_turns=2 if lidar.num_beams > 181 else 1,
        notes=(),
    )
    if name not in COARSE_LOGS:
        return own
    noise = pieces((0.0, COARSE_STD, 0.0))
    own = own._replace(name="coarse", range_noise=noise, range_resolution=0.05)
    return own._replace(turn_time=None, num_turns=1)


def walls_of(lidar: Lidar, poses: np.ndarray, scans: Scan) -> np.ndarray:
    """Walls (S, 4) [m]: the outline of the occupied cells of the map of scans at poses (T, 3)."""
    return world_grid.walls(occupancy_map(lidar, poses, scans, resolution=RESOLUTION))[0]


def fit_wheels(poses: np.ndarray, odom_poses: np.ndarray) -> Wheels:
    """How the odometry of T scans differs from poses (T, 3), by medians and robust regression.

    Steps from or to a pose that is not finite are left out.
    """
    true, read = increments(poses)[1:], increments(odom_poses)[1:]
    known = np.isfinite(true).all(axis=1)
    true, read = true[known], read[known]
    moves = np.abs(read[:, 0]) > MIN_TURN
    distance = float(np.median(true[moves, 0] / read[moves, 0])) if moves.any() else 1.0
    given, weight = read[:, [2, 0]], np.ones(len(read))
    for _ in range(20):
        factors = np.linalg.lstsq(given * weight[:, None], true[:, 2] * weight, rcond=None)[0]
        error = np.abs(true[:, 2] - given @ factors)
        weight = 1.0 / np.sqrt(1.0 + (error / (2.0 * np.median(error) + 1e-9)) ** 2)
    rolled = np.hypot(read[:, 0], read[:, 1]) + WHEEL_BASE / 2 * np.abs(read[:, 2])
    scaled = error / np.sqrt(np.maximum(rolled, MIN_TURN))
    std = HALF_NORMAL * float(np.median(scaled))
    turn, per_metre = factors.tolist()
    turn = turn if 0.5 < turn < 2.0 else 1.0  # of a drive that hardly turns it is not known
    return Wheels(distance, turn, per_metre, std, float(np.mean(scaled > 3.0 * std)))


def robot_of(scanner: Scanner, wheels: Wheels) -> Robot:
    """A robot of two wheels with these errors: of each wheel, s sqrt(2) / base = `turn_std`."""
    half = 0.5 * wheels.turn_per_metre * WHEEL_BASE
    return Robot(
        wheel_base=WHEEL_BASE,
        encoder_noise=wheels.turn_std * WHEEL_BASE / np.sqrt(2.0),
        wheel_scales=(wheels.distance - half, wheels.distance + half),
        wheel_base_scale=wheels.distance / wheels.turn,
        scanner=scanner,
    )


def velocities_of(log: LaserLog, poses: np.ndarray) -> np.ndarray:
    """Velocities (T, 3) [m/s, m/s, rad/s] at the scans, in the frame of the scanner.

    By the odometry around each scan; where there is none between scans, by the poses before and
    after.
    """
    times = log.times
    if np.array_equal(log.odom_stream_times, times):
        number = np.arange(len(times))
        before, after = np.maximum(number - 1, 0), np.minimum(number + 1, len(times) - 1)
        span = np.maximum(times[after] - times[before], 0.05)
        return relative(poses[before], poses[after]) / span[:, None]
    order = np.argsort(log.odom_stream_times, kind="stable")
    stamps, stream = log.odom_stream_times[order], log.odom_stream_poses[order]
    columns = (stream[:, 0], stream[:, 1], np.unwrap(stream[:, 2]))

    def at(wanted: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(wanted, stamps, x) for x in columns], axis=1)

    return relative(at(times - SPEED_SPAN), at(times + SPEED_SPAN)) / (2.0 * SPEED_SPAN)


def counterpart_of(name: str, log: LaserLog, poses: np.ndarray, walls: np.ndarray) -> Counterpart:
    """The counterpart of a log that has been mapped.

    Args:
        name: Of the log.
        log: The log.
        poses: (T, 3) [m, m, rad] estimated.
        walls: (S, 4) [m] of its map.
    """
    robot = robot_of(scanner_of(name, log.lidar), fit_wheels(poses, log.odom_poses))
    times = np.maximum.accumulate(log.times)
    return Counterpart(log.lidar, robot, World(walls), poses, times, velocities_of(log, poses))


def path_of(poses: np.ndarray, spacing: float = 0.3) -> np.ndarray:
    """Points (N, 2) [m] of a drive, about `spacing` [m] apart, along which people walk."""
    kept = [0]
    for k, at in enumerate(poses[:, :2]):
        if np.hypot(*(at - poses[kept[-1], :2])) > spacing:
            kept.append(k)
    return poses[kept, :2]


def simulate(key: jax.Array, counterpart: Counterpart, life: Life | None) -> LaserLog:
    """The log of a simulated drive of the counterpart."""
    odometry, scans = simulate_at_poses(
        key,
        counterpart.lidar,
        counterpart.robot,
        counterpart.world,
        counterpart.poses,
        times=counterpart.times - counterpart.times[0],
        velocities=counterpart.velocities,
        life=life,
    )
    ranges = np.where(np.asarray(scans.hit), np.asarray(scans.ranges), np.inf)
    poses = dead_reckoning(np.zeros(3), np.asarray(odometry, np.float64))
    return LaserLog.from_arrays(counterpart.times, poses, ranges, counterpart.lidar)
