"""A drive whose map contradicts itself, closed where it shows places twice.

Where scans contradict it, the heading was lost, or wheels and scans were both wrong, somewhere
before. From places that are found again, far from where the drive had them (`revisits`), follow
poses of the whole drive (`rotation_first`), and at which steps the motion cannot have been as
matched:

        o---o---o---o             o---o---o---o
        |           |             |           |
        o           o      ->     o           o      the places x are one: that step was longer
        |           |             |           |
        x     x-o---o             x ~ ~ ~ o---o

The filter is run again along these poses, so that it associates landmarks across the loops, and all
is smoothed again, with the measurements as they were except for these steps. What has come out is
taken only if it contradicts itself less.
"""

import numpy as np

from jaxslam.core.measurement import Measurement
from jaxslam.core.se2_np import increments, wrap_angle
from jaxslam.mapping.map_consistency import MapConsistency
from jaxslam.matching.map_places import ScanMap
from jaxslam.matching.revisits import Revisits, find_revisits
from jaxslam.pipeline import pieces
from jaxslam.pipeline.filtered import (
    Filtered,
    Run,
    filter_along,
    nothing_filtered,
    result_of,
    smoother_input,
)
from jaxslam.pipeline.results import SlamResult
from jaxslam.pipeline.self_check import is_contradicted
from jaxslam.pipeline.smoothing_stage import padded_problem
from jaxslam.smoothing.problem import SmoothingProblem
from jaxslam.smoothing.rotation_first import Factors, solve_rotation_first

MAX_ROUNDS = 3
"""Times that places are looked for, each in the map made before."""

REVISIT_STD = (0.1, 0.1, 0.02)
"""[m], [m], [rad] std of a place that was found again."""

CLOSURE_STD = 1.0
"""[m], [rad] std of what a loop closure does not constrain."""

WRONG_STEP = 5.0
"""[std] of a step, beyond which it was not as matched."""

LEAST_TRUST = 0.1
"""Inlier fraction, times weight of the wheels, of a step that is contradicted most."""

SHARE_COMPARED = 0.9
"""Share of the scans that were compared with other visits that still have to be, at least."""

LESS = 0.8
"""Factor by which the scans that contradict the map have to become fewer, at least."""


def close_again(run: Run, filtered: Filtered, result: SlamResult) -> tuple[Filtered, SlamResult]:
    """The result, if its map contradicts itself closed at places that were found again.

    Args:
        run: What all stages need.
        filtered: The keyframes that the filter was given.
        result: What came out.

    Returns:
        Both, as they were or closed.
    """
    if not (run.match_scans and run.smooth):
        return filtered, result
    for _ in range(MAX_ROUNDS):
        before = result.consistency
        if not is_contradicted(before):
            break
        measurements, _, scans = smoother_input(run, filtered)
        poses = result.poses[result.keyframes]
        if result.saved_poses is not None:
            poses = np.concatenate([result.saved_poses, poses])
        found = find_revisits(run.config.joining, ScanMap(run.config.frontend.lidar, poses, scans))
        is_new = found.second >= len(poses) - len(result.keyframes)
        found = Revisits(*(x[is_new] for x in found))
        if not len(found.first):
            break
        problem = padded_problem(
            run.config.filter,
            run.params,
            filtered.start,
            measurements,
            np.full(measurements.features.kind.shape, -1, np.int32),
            poses,
        )[0]
        poses, wrong = _solve(problem, result, poses, measurements, found)
        again = _filter_again(run, filtered, result, poses, wrong)
        again = again._replace(notes=(*filtered.notes, *_notes(result, found)))
        closed = result_of(run, again, poses)
        info = result.info  # estimates at the time stay what they were
        closed = closed._replace(
            online_poses=result.online_poses,
            info=closed.info._replace(pose=info.pose, pose_cov=info.pose_cov),
        )
        if not _is_better(closed.consistency, before):
            break
        filtered, result = again, closed
    return filtered, result


def _is_better(new: MapConsistency, old: MapConsistency) -> bool:
    """Whether a map contradicts itself clearly less than another one of the same scans.

    A drive that is torn apart contradicts itself nowhere: as many scans have to be compared.
    """
    compared = [int(np.isfinite(x.visit_contradiction).sum()) for x in (new, old)]
    unexplained = [float(np.mean(~x.explained)) for x in (new, old)]
    if compared[0] < SHARE_COMPARED * compared[1] or len(new.warnings) > len(old.warnings):
        return False
    is_clear = unexplained[0] < LESS * unexplained[1]
    return is_clear or (len(new.warnings) < len(old.warnings) and unexplained[0] <= unexplained[1])


def _solve(
    problem: SmoothingProblem,
    result: SlamResult,
    poses: np.ndarray,
    measurements: Measurement,
    found: Revisits,
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (K, 3) by motion, loop closures, and places found again; and wrong steps (K,)."""
    count = len(poses)
    motion = problem.odometry, problem.odometry_cov
    increment, matched_cov = (np.asarray(x, float)[:count] for x in motion)
    cov = matched_cov * _uncertainty(measurements)[:, None, None] ** 2
    num_saved = count - len(result.keyframes)
    steps, places = np.arange(1, count), len(found.first)
    parts = [
        Factors(
            first=steps - 1,
            second=steps,
            relative_pose=increment[1:],
            cov=cov[1:],
        ),
        Factors(
            first=found.first,
            second=found.second,
            relative_pose=found.relative_pose,
            cov=np.broadcast_to(np.diag(np.square(REVISIT_STD)), (places, 3, 3)),
        ),
    ]
    for closures, first_of in ((result.loop_closures, num_saved), (result.saved_closures, 0)):
        if closures is not None:
            information = closures.information + np.eye(3) / CLOSURE_STD**2
            parts.append(
                Factors(
                    first=closures.first + first_of,
                    second=closures.second + num_saved,
                    relative_pose=closures.relative_pose,
                    cov=np.linalg.inv(information),
                )
            )
    factors = Factors(*map(np.concatenate, zip(*parts, strict=True)))
    poses = solve_rotation_first(poses, factors).poses
    off = increments(poses) - increment
    off[:, 2] = wrap_angle(off[:, 2])
    square = np.sum(off * np.linalg.solve(matched_cov, off[..., None])[..., 0], axis=1)
    return poses, (square > WRONG_STEP**2) & (np.arange(count) > 0)


def _uncertainty(measurements: Measurement) -> np.ndarray:
    """Factor (K,) on the std of a step, which is large where scans or wheels contradict it."""
    match = measurements.scan_match
    assert match is not None
    trust = np.asarray(match.inlier_fraction, float)
    if match.odometry_weight is not None:
        trust = trust * np.asarray(match.odometry_weight)
    matched = np.asarray(match.information).any(axis=(1, 2))
    return np.where(matched, 1.0 / trust.clip(LEAST_TRUST, 1.0), 1.0)


def _filter_again(
    run: Run, filtered: Filtered, result: SlamResult, poses: np.ndarray, wrong: np.ndarray
) -> Filtered:
    """The keyframes filtered along poses (K, 3), measured as before except at wrong steps (K,)."""
    num_saved = len(poses) - len(result.keyframes)
    motion, wrong = increments(poses)[num_saved:], wrong[num_saved:]
    chunks, end = [], 0
    for chunk in filtered.chunks:
        start, end = end, end + len(chunk.keyframes)
        rows = np.flatnonzero(wrong[start:end])
        chunks.append(
            pieces.after_gap(chunk, rows, motion[start:end][rows]) if rows.size else chunk
        )
    again = nothing_filtered(run, filtered.start, filtered.saved)
    again = filter_along(run._replace(callback=None), again, chunks, motion)
    return again._replace(motion=motion)


def _notes(result: SlamResult, found: Revisits) -> tuple[str, ...]:
    """A note for each set of places that was found again."""
    num_saved = 0 if result.saved_poses is None else len(result.saved_poses)
    notes = []
    for number in np.unique(found.group):
        own = found.group == number
        first, second = (x[own] - num_saved for x in (found.first, found.second))
        later, earlier = result.keyframes[second], result.keyframes[first[first >= 0]]
        where = [f"scans {earlier.min()}-{earlier.max()}"] if earlier.size else []
        where += ["the saved map"] if (first < 0).any() else []
        notes.append(
            f"scans {later.min()}-{later.max()} show places that {' and '.join(where)} showed, "
            "elsewhere than wheels and scan matching have them: closed by "
            f"{np.count_nonzero(own)} places"
        )
    return tuple(notes)
