"""Arguments of simulations: taken in any form, and checked before anything is compiled.

An argument that is refused raises ValueError, which names it, what was given, and what is expected.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.arguments import as_float
from jaxslam.core.scan import Lidar
from jaxslam.core.types import Array
from jaxslam.simulation import named_worlds, worlds
from jaxslam.simulation.kinematics import KINEMATICS, turning_radius
from jaxslam.simulation.path_following import LOOKAHEAD, SEARCH_WINDOW
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.scanners import Scanner, check_scanner
from jaxslam.simulation.worlds import World, with_index

MIN_PATH_POINTS = 6  # the first and the sixth give the direction in which the drive starts
MAX_TURN = np.pi / 2  # [rad] between two scans; where it is more, a path is not followed
MAX_PATH_GAP = 1.0  # [m] between points of a path; of sparser ones the robot cuts the corners


def check_key(key: Any) -> None:
    """Raise ValueError unless this is one key made by `jax.random.key`."""
    is_key = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    if not is_key or key.shape:
        given = f"{key.dtype} {key.shape}" if isinstance(key, jax.Array) else repr(key)
        raise ValueError(f"key is {given}, not one key as jax.random.key(seed) makes it")


def as_robot(robot: Any) -> Robot:
    """The robot with Python's floats, so that it is static under jit.

    Raises:
        ValueError: It is no `Robot`, or one of its fields is not possible.
    """
    if not isinstance(robot, Robot):
        raise ValueError(f"robot is {type(robot).__name__}, not Robot")
    robot = Robot(*(_plain(*field) for field in robot._asdict().items()))
    for name in ("wheel_base", "wheel_base_scale", "scan_period", "max_speed", "max_turn_rate"):
        if not 0.0 < getattr(robot, name) < np.inf:
            raise ValueError(f"robot.{name} is {getattr(robot, name)}, not above 0")
    for name in ("encoder_noise", "steering_noise", "odometry_rate", "radius"):
        if not 0.0 <= getattr(robot, name) < np.inf:
            raise ValueError(f"robot.{name} is {getattr(robot, name)}, not 0 or more")
    if not all(0.0 < scale < np.inf for scale in robot.wheel_scales):
        raise ValueError(f"robot.wheel_scales is {robot.wheel_scales}, not two numbers above 0")
    if not all(0.0 <= noise < np.inf for noise in robot.slip_noise):
        raise ValueError(f"robot.slip_noise is {robot.slip_noise}, not three numbers of 0 or more")
    for name in ("mount", "nominal_mount", "time_offset", "steering_offset"):
        if not np.isfinite(getattr(robot, name)).all():
            raise ValueError(f"robot.{name} is {getattr(robot, name)}, not finite")
    _check_kinematics(robot)
    step, turn = robot.max_speed * robot.scan_period, robot.max_turn_rate * robot.scan_period
    if step > LOOKAHEAD or turn > MAX_TURN:
        raise ValueError(
            f"robot moves {step:.2f} m and turns {turn:.2f} rad from scan to scan, by max_speed, "
            f"max_turn_rate and scan_period; at most {LOOKAHEAD} m and {MAX_TURN:.2f} rad: let it "
            "drive slower, or scan more often"
        )
    if robot.scanner is not None:
        check_scanner(robot.scanner)
    return robot


def _check_kinematics(robot: Robot) -> None:
    """Raise ValueError unless a robot, whose numbers are possible, has what its drive needs."""
    drive = robot.kinematics
    if drive not in KINEMATICS:
        raise ValueError(f"robot.kinematics is {drive!r}, not one of {', '.join(KINEMATICS)}")
    if drive != "differential" and robot.wheel_scales[0] != robot.wheel_scales[1]:
        raise ValueError(
            f"robot.wheel_scales is {robot.wheel_scales}; of a drive that is {drive} both are the "
            "same number"
        )
    own = {
        "ackermann": ("max_steering", "min_turning_radius", "steering_noise", "steering_offset"),
        "holonomic": ("slip_noise",),
    }
    for other, names in own.items():
        for name in names if other != drive else ():
            if getattr(robot, name) != Robot._field_defaults[name]:
                raise ValueError(
                    f"robot.{name} is {getattr(robot, name)}: it is of a drive that is {other}, "
                    f"and this one is {drive}"
                )
    if drive != "ackermann":
        return
    if not (0.0 <= robot.max_steering < np.pi / 2 and 0.0 <= robot.min_turning_radius < np.inf):
        raise ValueError(
            f"robot.max_steering is {robot.max_steering} and robot.min_turning_radius "
            f"{robot.min_turning_radius}, not in [0, pi / 2) and 0 or more"
        )
    if not turning_radius(robot) > 0.0:
        raise ValueError(
            "robot.max_steering and robot.min_turning_radius are 0; one of them bounds the "
            "curvature of a drive that is ackermann"
        )
    bound = np.arctan(robot.wheel_base / turning_radius(robot))
    if abs(robot.steering_offset) + bound >= np.pi / 2:
        raise ValueError(
            f"robot.steering_offset is {robot.steering_offset}; with the largest steering angle, "
            f"{bound:.3f}, it is pi / 2 or more"
        )


def check_lidar_of(robot: Robot, lidar: Lidar) -> None:
    """Raise ValueError unless the configuration's scanner is that of the robot, if it has one."""
    if robot.scanner is None:
        return
    own = robot.scanner.lidar()
    for name, ours, theirs in zip(Lidar._fields, own, lidar, strict=True):
        if name != "range_std" and not np.isclose(ours, theirs, rtol=1e-6, atol=1e-9):
            raise ValueError(
                f"config.frontend.lidar.{name} is {theirs}, and that of robot.scanner is {ours}; "
                "make the configuration with Config.for_lidar(robot.scanner.lidar())"
            )


def _plain(name: str, value: Any) -> Any:
    """A field of a robot as a float, or as a tuple of floats where the default is one."""
    if name in ("kinematics", "scanner"):
        wanted = str if name == "kinematics" else Scanner
        if not isinstance(value, wanted) and not (name == "scanner" and value is None):
            raise ValueError(f"robot.{name} is {type(value).__name__}, not {wanted.__name__}")
        return value
    shape = np.shape(Robot._field_defaults[name])
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        numbers = None
    if numbers is None or numbers.shape != shape:
        wanted_form = f"{shape[0]} numbers" if shape else "a number"
        raise ValueError(f"robot.{name} is {value!r}, not {wanted_form}")
    return tuple(numbers.tolist()) if shape else float(numbers)


def as_world(world: Any, range_max: float | None = None) -> World:
    """A world in JAX's precision, of its name or of walls; many walls with an index.

    Args:
        world: Its name, or its walls. An index that they have is made anew.
        range_max: [m] of the scanner that will be there; None to make no index.

    Raises:
        ValueError: There is no world of this name, or the walls are not (S, 4) finite numbers.
    """
    if isinstance(world, str):
        walls = jnp.asarray(named_worlds.named(world).walls, float)
        return World(walls) if range_max is None else with_index(World(walls), range_max)
    if not isinstance(world, World):
        raise ValueError(
            f"world is {type(world).__name__}, not World or one of the names "
            f"{', '.join(worlds.NAMES)}"
        )
    walls = as_float("world.walls", world.walls, ("S", 4))
    if not np.isfinite(walls).all():
        raise ValueError("world.walls holds numbers that are not finite")
    return World(walls) if range_max is None else with_index(World(walls), range_max)


def as_path(path: Any, world: Any) -> Array:
    """A path (N, 2) [m] in JAX's precision.

    Args:
        path: Its points; None for the drive of the world: its own, a patrol in a random building.
        world: Name of the world, or `World`.

    Raises:
        ValueError: The points are not finite, too few, or too far apart or too close together to be
            followed; or there is no path, and the world has none of its own.
    """
    if path is None:
        if not isinstance(world, str):
            raise ValueError(
                "path is None; a world without a name has no drive of its own: find one with "
                "jaxslam.simulation.patrols"
            )
        return jnp.asarray(named_worlds.named_path(world), float)
    points = as_float("path", path, ("N", 2))
    check_path(points)
    if not np.isfinite(points).all():
        raise ValueError("path holds numbers that are not finite")
    gaps = np.hypot(*np.diff(np.asarray(points, float), axis=0).T)
    advice = "make it of waypoints by jaxslam.simulation.path_following.densify"
    if gaps.max() > MAX_PATH_GAP:
        raise ValueError(
            f"path has points {gaps.max():.2f} m apart; at most {MAX_PATH_GAP} m: {advice}"
        )
    if gaps.sum() > LOOKAHEAD > np.median(gaps) * (SEARCH_WINDOW - 1):
        raise ValueError(
            f"path has points {np.median(gaps):.4f} m apart; {SEARCH_WINDOW} of them must span "
            f"{LOOKAHEAD} m: {advice}"
        )
    return points


def check_path(path: Array) -> None:
    """Raise ValueError if a path (N, 2) has too few points to start along; while tracing, too."""
    if path.ndim != 2 or path.shape[1] != 2 or path.shape[0] < MIN_PATH_POINTS:
        raise ValueError(f"path is {path.shape}, not (N >= {MIN_PATH_POINTS}, 2)")
