"""Scan matching beside other libraries, scan after scan of a simulated drive, on one core.

small_gicp registers each scan with the one before, from the motion that the wheels measured;
KISS-ICP matches it with a map of its own, and uses no wheels. Both are made for points in space: a
scan is given to them as points in a plane, and where they need surfaces, in three planes, as walls
stand upright. jaxslam matches a scan with its last keyframes. What is not installed is left out.
"""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import NamedTuple

import jax
import numpy as np

from experiments import common
from experiments.common import Numbers
from experiments.timing import fastest
from jaxslam.core import se2_np
from jaxslam.core.scan import Lidar, Scan
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.lidar import beam_angles
from jaxslam.matching import ScanMatchSpec, empty_submap, match_scans
from jaxslam.simulation import drives

LAYER_HEIGHTS = (-0.1, 0.0, 0.1)  # [m] of the planes of a scan where surfaces are needed
SAMPLING = 0.02  # [m] of a scan's points: nearly all of them
RANGE_BY_VOXEL = 100.0  # of KISS-ICP's default, range_max by the size of a voxel
Matcher = Callable[[], np.ndarray]
"""Function that matches all scans and returns the increments (T, 3); the first is not compared."""


class Drive(NamedTuple):
    """Scans of a drive.

    Attributes:
        lidar: The scanner.
        scans: [T].
        truth: (T, 3) [m, m, rad] true increments since the scan before.
        odometry: (T, 3) what the wheels measured.
    """

    lidar: Lidar
    scans: Scan
    truth: np.ndarray
    odometry: np.ndarray


def simulate(seed: int, num_scans: int) -> Drive:
    """The first scans of the office drive."""
    lidar, key = FrontendConfig().lidar, jax.random.key(seed)
    world, robot, path, most = common.drive_in()
    poses, odometry, scans = drives.simulate_scans(
        key, lidar, robot, world, path, num_scans=min(num_scans, most)
    )
    truth = se2_np.increments(np.asarray(poses, float))
    return Drive(lidar, scans, truth, np.asarray(odometry))


def clouds(drive: Drive, heights: tuple[float, ...] = (0.0,)) -> list[np.ndarray]:
    """Points (N, 3) [m] of each scan in the robot frame, once at each height."""
    angles = np.asarray(beam_angles(drive.lidar), float)
    unit = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    found = []
    ranges, hits = np.asarray(drive.scans.ranges, float), np.asarray(drive.scans.hit)
    for each, hit in zip(ranges, hits, strict=True):
        plane = (each[:, None] * unit)[hit]
        layers = [np.pad(plane, ((0, 0), (0, 1)), constant_values=z) for z in heights]
        found.append(np.concatenate(layers))
    return found


def in_space(pose: np.ndarray) -> np.ndarray:
    """Transformation (4, 4) of a pose in the plane."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    found = np.eye(4)
    found[:2] = [[c, -s, 0.0, pose[0]], [s, c, 0.0, pose[1]]]
    return found


def in_plane(transformation: np.ndarray) -> np.ndarray:
    """Pose (3,) in the plane of a transformation (4, 4)."""
    t = np.asarray(transformation)
    return np.array([t[0, 3], t[1, 3], np.arctan2(t[1, 0], t[0, 0])])


def _own(use_odometry: bool, drive: Drive) -> Matcher:
    spec = ScanMatchSpec(use_odometry=use_odometry)
    submap = empty_submap(spec, drive.lidar)
    scans, odometry = jax.device_put((drive.scans, drive.odometry))

    def match() -> np.ndarray:
        return np.asarray(match_scans(spec, drive.lidar, submap, scans, odometry)[1].increment)

    return match


def _small_gicp(kind: str, drive: Drive) -> Matcher:
    align = import_module("small_gicp").align
    points = clouds(drive, (0.0,) if kind == "ICP" else LAYER_HEIGHTS)

    def match() -> np.ndarray:
        found = [np.zeros(3)]
        steps = zip(points, points[1:], drive.odometry[1:], strict=False)
        for before, now, guess in steps:
            result = align(
                before,
                now,
                init_T_target_source=in_space(guess),
                registration_type=kind,
                downsampling_resolution=SAMPLING,
                num_threads=1,
            )
            found.append(in_plane(result.T_target_source))
        return np.stack(found)

    return match


def _kiss_icp(drive: Drive) -> Matcher:
    odometry_of = import_module("kiss_icp.kiss_icp").KissICP
    config = import_module("kiss_icp.config").KISSConfig()
    config.data.max_range, config.data.deskew = drive.lidar.range_max, False
    config.mapping.voxel_size = drive.lidar.range_max / RANGE_BY_VOXEL
    config.registration.max_num_threads = 1
    points, no_times = clouds(drive), np.zeros(0)

    def match() -> np.ndarray:
        kiss, poses = odometry_of(config), []
        for now in points:
            kiss.register_frame(now, no_times)
            poses.append(in_plane(kiss.last_pose))
        return se2_np.increments(np.stack(poses))

    return match


MATCHERS: dict[str, Callable[[Drive], Matcher]] = {
    "jaxslam": partial(_own, True),
    "jaxslam, no wheels": partial(_own, False),
    "small_gicp, ICP": partial(_small_gicp, "ICP"),
    "small_gicp, plane ICP": partial(_small_gicp, "PLANE_ICP"),
    "small_gicp, GICP": partial(_small_gicp, "GICP"),
    "KISS-ICP": _kiss_icp,
}


def errors(truth: np.ndarray, found: np.ndarray) -> Numbers:
    """RMS errors of increments (T, 3), of all but the first, and the largest.

    Returns:
        `position_rms_mm`, `heading_rms_deg` and `position_max_mm`.
    """
    error = se2_np.relative(truth, np.asarray(found, float))[1:]
    distance = 1e3 * np.hypot(error[:, 0], error[:, 1])
    return {
        "position_rms_mm": float(np.sqrt(np.mean(distance**2))),
        "heading_rms_deg": float(np.degrees(np.sqrt(np.mean(error[:, 2] ** 2)))),
        "position_max_mm": float(distance.max()),
    }


def table(seed: int, num_scans: int, repeats: int) -> Numbers:
    """Errors and milliseconds a scan of each that is installed, and the errors of the wheels."""
    drive = simulate(seed, num_scans)
    calls, missing, notes = {}, [], {}
    rows: Numbers = {"wheels": {"ms_per_scan": None, **errors(drive.truth, drive.odometry)}}
    for name, make in MATCHERS.items():
        try:
            match = make(drive)
            rows[name] = errors(drive.truth, match())
            calls[name] = (match,)
        except ImportError:
            missing.append(name)
        except Exception as error:  # another version of a peer can fail with any error
            notes[name] = f"{type(error).__name__}: {error}"[:200]
    taken = fastest(calls, repeats=repeats)
    count = len(drive.truth)
    for name, seconds in taken.items():
        rows[name] = {"ms_per_scan": 1e3 * seconds / count, **rows[name]}
    return {"scans": count, "not_installed": missing, "notes": notes, "rows": rows}


def print_table(numbers: Numbers) -> None:
    """Print a line for each."""
    heads = ("ms a scan", "RMS mm", "RMS deg", "max mm")
    print(f"{'scan matching':26}" + "".join(f"{head:>13}" for head in heads))
    for name, row in numbers["rows"].items():
        shown = ("-" if x is None else f"{x:.3g}" for x in row.values())
        print(f"{name:26}" + "".join(f"{text:>13}" for text in shown))
    if numbers["not_installed"]:
        print(f"not installed: {', '.join(numbers['not_installed'])}")
    for name, note in numbers["notes"].items():
        print(f"{name}: {note}")
