"""What `jaxslam run` writes of a map: the numbers, the files and the figures."""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxslam.cli import map_files, report, room_results
from jaxslam.cli.run_evaluation import (
    RecordedDrive,
    breaks_of,
    drive_in_map,
    errors_of,
    not_used,
)
from jaxslam.core.batching import on_device
from jaxslam.core.measurement import Measurement
from jaxslam.core.regions import Regions
from jaxslam.core.se2_np import compose, relative, trajectories_as_one
from jaxslam.core.time_series import match_times
from jaxslam.core.types import Metrics
from jaxslam.evaluation import log_errors
from jaxslam.filtering.config import confirmed
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import tum
from jaxslam.io.annotated_map import AnnotatedMap
from jaxslam.mapping.planner_data import planner_data
from jaxslam.mapping.saved_map import SavedMap
from jaxslam.pipeline.log_input import LogInput
from jaxslam.pipeline.results import SlamResult


class RunContext(NamedTuple):
    """What all maps of a run have in common.

    Attributes:
        drives: The logs, in the order of their scans in `given`.
        given: All of them as input of SLAM.
        params: Q and R of the filter.
        smooth: Whether trajectories are smoothed.
        of_base: Whether trajectory.tum holds poses of the robot, not of the scanner.
        gif: Whether an animation is written.
        saved_map: The map that the run goes on in, if any.
        annotated_map: Its map.geojson, with what a user added.
        earlier_rooms: Its rooms and doors, whose names are kept.
    """

    drives: tuple[RecordedDrive, ...]
    given: LogInput
    params: NoiseParams
    smooth: bool
    of_base: bool
    gif: bool
    saved_map: SavedMap | None = None
    annotated_map: AnnotatedMap | None = None
    earlier_rooms: Regions | None = None


def write(
    context: RunContext, result: SlamResult, out_dir: Path, extra: Metrics
) -> tuple[Metrics, int]:
    """Write all files of a map.

    Args:
        context: Of the run.
        result: The map, of all scans or of a part of them.
        out_dir: Folder to write to.
        extra: Numbers in addition.

    Returns:
        The numbers of metrics.json, and how many parts of the run contradict the map.
    """
    given = context.given
    config, scans = given.config, given.scans
    consistency = result.consistency
    own = np.flatnonzero(np.isfinite(result.poses).all(axis=1))
    numbers: Metrics = extra | {
        "scans": len(own),
        "keyframes": len(result.keyframes),
        "landmarks": int(np.sum(confirmed(config.filter, result.belief))),
        "matches": float(np.mean(np.sum(np.asarray(result.info.used), axis=1))),
        "closures": sum(
            len(closures.first)
            for closures in (result.loop_closures, result.saved_closures)
            if closures is not None
        ),
        "map_consistency": consistency.metrics(),
    }
    several, path_length, first_row = len(context.drives) > 1, 0.0, 0
    notes: list[str] = []
    lines: dict[str, list[np.ndarray]] = {"odometry": [], "reference": []}
    errors = np.full((len(result.keyframes), 3), np.nan)
    for number, drive in enumerate(context.drives):
        here = drive_in_map(given, result, drive, first_row)
        first_row += len(drive.log.times)
        notes += not_used(drive, here)
        if not len(here.rows):
            continue
        path = here.result.poses if given.match_scans else here.odometry
        length = sum(log_errors.path_length(x) for x in np.split(path, breaks_of(here.result)))
        path_length += length
        at_start = number == 0 and result.saved_poses is None
        about, error, more = errors_of(drive, here, smooth=context.smooth, at_start=at_start)
        notes += more
        if error is not None:
            errors[np.isin(result.keyframes, here.rows)] = error
        if several:
            numbers.setdefault("drives", []).append(
                {"log": str(drive.path), "scans": len(here.rows), "path_length_m": length} | about
            )
        else:
            numbers |= about
        suffix = f".{number + 1}" if several else ""
        poses = here.result.poses
        if context.of_base:
            base = relative(drive.log.mount, np.zeros(3))  # the robot in the scanner's frame
            poses = compose(poses, base)
        tum.write(out_dir / f"trajectory{suffix}.tum", here.log.times, poses)
        lines["odometry"].append(here.odometry)
        if drive.reference is not None and len(match_times(here.log.times, drive.reference[0])) > 1:
            lines["reference"].append(
                log_errors.reference_in_map(here.log.times, here.result.poses, drive.reference)
            )
    numbers["path_length_m"] = path_length
    numbers["mended"] = [*numbers.get("mended", ()), *notes]
    saved, old = context.saved_map, context.annotated_map
    if result.saved_poses is None:  # a map of its own
        saved, old = None, None
    next_id = max(int(result.belief.next_id), result.next_id)
    graph, occupancy = result.topological_map, result.occupancy
    assert occupancy is not None  # of `run_slam`
    earlier = None if saved is None else context.earlier_rooms
    radius = config.mapping.robot_radius
    rooms = room_results.write_rooms_of(out_dir, occupancy, earlier, robot_radius=radius)
    planner = planner_data(graph, occupancy, rooms)
    numbers |= {"rooms": len(rooms.regions), "doors": len(rooms.doors)}
    arc_ids = report.write_results(out_dir, numbers, graph, old, next_id, rooms, planner)
    map_files.draw_map(out_dir / "map.png", occupancy, graph, rooms)
    measurements = Measurement(
        on_device(result.odometry), result.features, scan_match=result.scan_matches
    )
    config = config._replace(  # the map has grown to its size, which the files are made for
        filter=config.filter._replace(max_landmarks=result.belief.num_seen.size)
    )
    of_keyframes = jax.tree.map(lambda x: np.asarray(x)[result.keyframes], scans)
    times = np.concatenate([drive.log.times for drive in context.drives])[result.keyframes]
    report.write_maps(
        out_dir,
        config,
        context.params,
        result,
        measurements,
        times,
        of_keyframes,
        saved,
        rooms,
        planner,
        arc_ids,
    )
    bounds = [(warning.first_scan, warning.last_scan) for warning in consistency.warnings]
    report.draw(
        out_dir,
        config,
        result,
        {what: trajectories_as_one(line) for what, line in lines.items() if line},
        errors if np.isfinite(errors).any() else None,
        scans=of_keyframes,
        saved_scans=None if saved is None else saved.scans,
        wrong=bounds,
    )
    if context.gif:
        from jaxslam.viz import animation  # imported here, because matplotlib is slow to import

        at = np.searchsorted(own, result.keyframes)
        animation.animate_run(
            out_dir / "run.gif",
            config,
            context.params,
            measurements if saved is None else _from_first(measurements),
            of_keyframes,
            result.poses[result.keyframes],
            np.concatenate(lines["odometry"])[at],
        )
    return numbers, len(consistency.warnings)


def _from_first(measurements: Measurement) -> Measurement:
    """Measurements [K] of the filter, the first without the motion from a saved map to it."""
    match = measurements.scan_match
    if match is None or match.expected is None:
        return measurements
    increment, expected = np.array(match.increment), np.array(match.expected)
    increment[0] = expected[0] = 0.0
    return measurements._replace(
        scan_match=match._replace(increment=increment, expected=expected)  # type: ignore[arg-type]
    )
