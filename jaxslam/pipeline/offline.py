"""SLAM on a whole log: chunks of keyframes, then batch smoothing with loop closures."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np

from jaxslam.core.se2_np import compose, relative
from jaxslam.filtering.noise import NoiseParams
from jaxslam.mapping.saved_map import SavedMap
from jaxslam.pipeline import (
    arguments,
    keyframes,
    mapping_stage,
    odometry_notes,
    online,
    pieces,
    reclosing,
    sessions,
    stages,
)
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.filtered import (
    Callback,
    Filtered,
    Run,
    filter_along,
    filter_chunks,
    nothing_filtered,
    result_of,
    scan_map,
)
from jaxslam.pipeline.online import SlamState
from jaxslam.pipeline.pieces import Group
from jaxslam.pipeline.results import SlamResult
from jaxslam.pipeline.self_check import remark
from jaxslam.pipeline.stages import Drive, KeyframeChunk


def run_slam(
    config: Config,
    params: NoiseParams,
    odometry: Any,
    ranges: Any,
    *,
    start: Any = None,
    odometry_guessed: Any = None,
    after_pause: Any = None,
    new_drive: Any = None,
    saved_map: SavedMap | None = None,
    match_scans: bool = True,
    smooth: bool = True,
    callback: Callback | None = None,
) -> SlamResult:
    """Run SLAM on a whole log.

    Every scan is matched, in order; front end, filter and smoother work on keyframes, which are
    chosen by the matched motion (`config.keyframe_distance`), and the poses of the scans between
    them follow from their own matched motion (`keyframes`). Every scan is a keyframe without scan
    matching, and where by the odometry more than half of them would be.

    The filter estimates each pose from the measurements up to it. With `smooth`, all poses and
    landmarks are estimated from all measurements (`sparse.smooth_log`), and where scans are
    matched, loops are closed by matching scans of later visits with those of earlier ones
    (`loop_closure.find_loop_closures`).

    Where the map contradicts itself and is smoothed, the drive is closed at places that are found
    again, metres from where it has them (`reclosing`), if that makes it better; a note says so. At
    the end the topological map is made of all scans at these poses (`mapping_stage`); that of
    several drives loses arcs on which the last scans see obstacles.

    Where the robot was moved from one scan to the next (`breaks`), the pieces of the drive are
    mapped on their own, and joined where places are found again (`pieces`). The result is the
    largest map; what nothing joins to it is in `other_parts`.

    Args:
        config: For the scanner, as `Config.for_laser_log` makes it; `config.filter.max_landmarks`
            is the largest size of the map.
        params: Q and R of the filter, as `NoiseParams.for_laser_log(match_scans=True)`.
        odometry: (T, 3) [m, m, rad] increments: the motion since the scan before, in the frame of
            the pose before, zero at the first; `core.se2_np.increments` makes them from poses.
        ranges: (T, R) raw ranges [m] of the scanner's R beams; NaN, infinite, not above zero or not
            below `range_max` is no return. Or a `Scan` [T].
        start: (3,) [m, m, rad] first pose, map frame; zero by default.
        odometry_guessed: (T,) bool, which increments of the odometry are guesses of whoever read
            the log, not what the wheels said (`LaserLog.odometry_guessed`); none by default.
        after_pause: (T,) bool, before which scans the robot may have been moved unseen, as
            `breaks.pauses` finds them by time; none by default. Only such as contradict the wheels,
            or fit the scans before badly, are breaks.
        new_drive: (T,) bool, which scans begin another drive, at an unknown place; none by default.
        saved_map: A map to go on in, of the same scanner. Where places of it are found again, the
            result is in its frame and goes on with its landmarks and their ids; where none are,
            it is a map of its own, and a note says so. `start` is then not used.
        match_scans: Whether scans are matched, and the increments fused with the odometry.
        smooth: Whether the trajectory is smoothed at the end.
        callback: Called after each chunk of keyframes with the state and the result of the chunk,
            of a broken drive for the first piece, and then for those that are joined to others;
            the submap of the state may already hold later scans.

    Raises:
        ValueError: An argument has another shape, or does not fit the others; the odometry holds
            poses; scans are matched and `params.scan_match_std_scale` is None; or they are not, and
            there are several drives.
    """
    arguments.check_config(config)
    params = arguments.as_params(params, match_scans=match_scans)
    increments = arguments.as_log_odometry(odometry)
    # NumPy, as each slice of a JAX array would be compiled.
    scans = arguments.as_scans(config.frontend.lidar, ranges, len(increments))
    pose = arguments.as_start(start)
    notes: tuple[str, ...] = ()
    count = len(increments)
    guessed = arguments.as_flags("odometry_guessed", odometry_guessed, count)
    after_pause = arguments.as_flags("after_pause", after_pause, count)
    new_drive = arguments.as_flags("new_drive", new_drive, count)
    if not match_scans and (new_drive[1:].any() or saved_map is not None):
        name = "saved_map" if saved_map is not None else "new_drive"
        raise ValueError(f"{name}: drives are joined by their scans; take match_scans=True")
    if saved_map is not None:
        sessions.check_saved_map(saved_map, config.frontend.lidar)
    if match_scans and config.scan_matching.use_odometry:
        unknown = after_pause | new_drive
        increments, is_share, notes = odometry_notes.share_out(increments, scans, unknown)
        guessed |= is_share
    elif match_scans:
        increments = np.zeros_like(increments)
    distance = keyframes.distance_for_log(config.keyframe_distance, increments)
    config = config._replace(keyframe_distance=distance)
    run = Run(config, params, scans, match_scans, smooth, callback)
    state = online.init(config, pose, match_scans=match_scans)
    drive = Drive(increments, scans, guessed, after_pause, new_drive)
    log = stages.keyframe_chunks(config, state.submap, drive)
    with closing(log):  # whatever happens, no scans are matched any more after it
        first, later = _first_piece(run, state, pose, log)
    if later or saved_map is not None:
        results = _several_pieces(run, first, later, saved_map)
    else:
        results = [reclosing.close_again(run, first, result_of(run, first))[1]]
    results = [mapping_stage.with_maps(config, scans, each, saved_map) for each in results]
    results.sort(key=_importance)
    main, *others = results
    if saved_map is not None and main.saved_poses is None:
        notes += ("no place of the saved map was found again: this is a map of its own",)
    for part in others:
        spans = _spans(part.piece)
        notes += (
            f"scans {spans} share no place with the rest that was found again: they are a map of "
            "their own",
        )
    others = [part._replace(notes=part.notes + remark(part.consistency)) for part in others]
    notes += main.notes + remark(main.consistency)
    return main._replace(notes=notes, other_parts=tuple(others))


def _spans(piece: np.ndarray) -> str:
    """First and last scans of the pieces (T,) in a map."""
    numbers = [np.flatnonzero(piece == k) for k in np.unique(piece[piece >= 0])]
    return " and ".join(f"{own[0]}-{own[-1]}" for own in numbers)


def _importance(result: SlamResult) -> tuple[bool, int]:
    """Sorts results: what goes on in a saved map first, then those of most scans."""
    return result.saved_poses is None, -int(np.count_nonzero(result.piece >= 0))


def _first_piece(
    run: Run, state: SlamState, start: Any, log: Iterable[KeyframeChunk]
) -> tuple[Filtered, list[KeyframeChunk]]:
    """Filter the first piece of a log while its next scans are matched; and the chunks after it."""
    filtered, chunks = Filtered(start, state), iter(log)
    following = next(chunks, None)
    while following is not None and following.piece == 0:
        now, following = following, next(chunks, None)  # in the background of the filter
        filtered = filter_chunks(run, filtered, [now])
    return filtered, [] if following is None else [following, *chunks]


def _several_pieces(
    run: Run, first: Filtered, later: Sequence[KeyframeChunk], saved: SavedMap | None
) -> list[SlamResult]:
    """Results of the groups of pieces, and perhaps of a saved map, that can be joined."""
    quiet, alone = run._replace(callback=None), {0: first}
    for chunk in later:
        if chunk.piece not in alone:
            start = arguments.as_start(None)
            alone[chunk.piece] = nothing_filtered(run, start)
        alone[chunk.piece] = filter_chunks(quiet, alone[chunk.piece], [chunk])
    found = {}
    for number, piece in alone.items():
        alone[number], found[number] = reclosing.close_again(quiet, piece, result_of(run, piece))
    maps = {number: scan_map(run, one) for number, one in found.items()}
    if saved is not None:
        maps[pieces.SAVED] = sessions.scan_map(saved)
        start = arguments.as_start(saved.poses[0])
        alone[pieces.SAVED] = nothing_filtered(run, start, saved)
    results = []
    firsts = {number: piece.chunks[0] for number, piece in alone.items() if piece.chunks}
    across = {k: x.across_break for k, x in firsts.items() if x.across_break is not None}
    for group in pieces.group_pieces(run.config.joining, maps, across):
        number, *left = group.pieces
        if left:
            filtered = alone[number]
            own = [compose(frame, maps[k].poses) for k, frame in group.frames.items()]
            for before, after, number in zip(own, own[1:], left, strict=False):
                chunks, motion = alone[number].chunks, alone[number].motion
                gap = relative(before[-1], after[0])
                chunks = (pieces.after_gap(chunks[0], np.array([0]), gap[None]), *chunks[1:])
                if motion is None:
                    filtered = filter_chunks(run, filtered, chunks)
                else:
                    motion = np.concatenate([gap[None], motion[1:]])
                    filtered = filter_along(run, filtered, chunks, motion)
            filtered = filtered._replace(notes=_notes(group, alone))
            result = result_of(run, filtered, np.concatenate(own))
            results.append(reclosing.close_again(quiet, filtered, result)[1])
        elif number != pieces.SAVED:
            results.append(found[number])
    return results


def _notes(group: Group, alone: Mapping[int, Filtered]) -> tuple[str, ...]:
    """The notes of the pieces of a group, and one of how they were joined."""
    names = []
    for number in group.pieces:
        chunks = alone[number].chunks
        first, last = (chunks[0].keyframes[0], chunks[-1].keyframes[-1]) if chunks else (0, 0)
        names.append(f"scans {first}-{last}" if chunks else "the saved map")
    places = [join.num_places for join in group.joins if join.num_places]
    how = [f"by {min(places)} places that were found again"] if places else []
    if len(places) < len(group.joins):
        how.append("as scan matching has it across a break")
    joined = f"{' and '.join(names)} were mapped alone, and joined {', or '.join(how)}"
    return (*[note for k in group.pieces for note in alone[k].notes], joined)
