"""Stages of a whole log: scan matching runs ahead, and its keyframes are gathered to chunks.

Every scan is matched, in chunks of `CHUNK` scans. Features, arcs and filter work on keyframes
alone, in chunks of `CHUNK` keyframes: so their programs have the shapes of all others, however many
scans are between two keyframes.

    time --->
    worker       | matching 0 | matching 1 | matching 2 | matching 3 | ...
    keyframes                              ^ CHUNK of them            ^ CHUNK more
    front end                              | features 0 |            | features 1 |
    filter                                                           | filter 0   | filter 1 | ...

Where the drive is broken (`breaks`), matching begins again with an empty submap, and the keyframes
after it are those of another piece, in chunks of their own.

Scan matching needs neither features nor filter: a worker thread matches scan after scan, while the
main thread waits only for keyframes and for the results of the filter.
"""

from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.core.measurement import ScanMatch
from jaxslam.core.scan import Scan
from jaxslam.matching.icp import Submap
from jaxslam.pipeline import breaks, chunks, keyframes
from jaxslam.pipeline.chunks import Chunk
from jaxslam.pipeline.config import Config


class MatchedScans(NamedTuple):
    """Motion of N successive scans, NumPy.

    Attributes:
        is_keyframe: (N,) bool.
        odometry: (N, 3) [m, m, rad] increments by the wheels.
        matches: [N] increments by scan matching; None where scans are not matched.
    """

    is_keyframe: np.ndarray
    odometry: np.ndarray
    matches: ScanMatch | None

    @property
    def increments(self) -> np.ndarray:
        """Increments (N, 3) [m, m, rad] that keyframes are chosen by."""
        return self.odometry if self.matches is None else np.asarray(self.matches.increment)


class KeyframeChunk(NamedTuple):
    """Keyframes that have passed the front end.

    Attributes:
        chunk: For the filter; a step is from keyframe to keyframe.
        keyframes: (N,) int number of each in the log.
        odometry: (N, 3) [m, m, rad] increments by the wheels from keyframe to keyframe.
        matched: [S] all scans after the last keyframe of the chunk before, up to the last of this.
        piece: Number of the piece of the drive that they belong to, from 0.
        across_break: (3,) [m, m, rad] motion to the first of them from the scan before, which ends
            another piece, as scan matching has it; it may be wrong. None where it has nothing.
    """

    chunk: Chunk
    keyframes: np.ndarray
    odometry: np.ndarray
    matched: MatchedScans
    piece: int = 0
    across_break: np.ndarray | None = None


def with_scan_match(chunk: KeyframeChunk, match: ScanMatch) -> KeyframeChunk:
    """The chunk with other scan matches [CHUNK] for the filter."""
    measurements = chunk.chunk.measurements._replace(scan_match=match)
    return chunk._replace(chunk=chunk.chunk._replace(measurements=measurements))


class Drive(NamedTuple):
    """What is matched: T scans with odometry, NumPy.

    Attributes:
        odometry: (T, 3) [m, m, rad] increments.
        scans: [T].
        guessed: (T,) bool, which increments are guesses of the reader.
        after_pause: (T,) bool, before which scans the robot may have been moved unseen.
        new_drive: (T,) bool, before which scans it surely was.
    """

    odometry: np.ndarray
    scans: Scan
    guessed: np.ndarray
    after_pause: np.ndarray
    new_drive: np.ndarray


def keyframe_chunks(
    config: Config, submap: Submap | None, drive: Drive
) -> Generator[KeyframeChunk]:
    """Match the scans of a log, and extract features and arcs of its keyframes, chunk by chunk.

    Keyframes are chosen by `config.keyframe_distance`; the first and the last scan of each piece
    are some, too. Close the iterator to stop the worker thread.

    Args:
        config: Of front end, scan matching and keyframes.
        submap: Of the scan matcher, empty; None where scans are not matched: all are keyframes.
        drive: The log.
    """
    piece, first, before, after, waiting = 0, 0, None, submap, None
    across_break = None

    def complete(count: int) -> Iterator[KeyframeChunk]:
        """The first `count` keyframes that wait, in chunks."""
        nonlocal first, waiting, across_break
        assert waiting is not None
        ends, start = np.flatnonzero(waiting.is_keyframe) + 1, 0
        for k in range(0, count, chunks.CHUNK):
            end = int(ends[k : min(k + chunks.CHUNK, count)][-1])
            some = _part(waiting, start, end)
            chunk = _extract(config, after, first + start, some, drive.scans)
            yield chunk._replace(piece=piece, across_break=across_break)
            start, across_break = end, None
        first, waiting = first + start, _part(waiting, start, None)

    def rest() -> Iterator[KeyframeChunk]:
        """All that wait; the last one is a keyframe."""
        if waiting is not None and len(waiting.is_keyframe):
            waiting.is_keyframe[-1] = True
            yield from complete(int(np.count_nonzero(waiting.is_keyframe)))

    for part in _match_ahead(config, submap, drive):
        if part.starts_piece:
            yield from rest()
            piece, before, across_break = piece + 1, None, part.across_break
        after = part.submap
        matched = MatchedScans(np.ones(len(part.odometry), bool), part.odometry, part.matches)
        if part.matches is not None:
            is_keyframe, before = keyframes.choose_keyframes(
                config.keyframe_distance, matched.increments, before
            )
            matched = matched._replace(is_keyframe=is_keyframe)
        waiting = matched if waiting is None else concatenate([waiting, matched])
        num_waiting = int(np.count_nonzero(waiting.is_keyframe))
        yield from complete(num_waiting // chunks.CHUNK * chunks.CHUNK)
    yield from rest()


def _part(matched: MatchedScans, start: int, end: int | None) -> MatchedScans:
    """The scans from number `start` up to, without, `end`."""
    return jax.tree.map(lambda x: x[start:end], matched)


def concatenate(parts: list[Any]) -> Any:
    """Arrays of several records that lead with scans, one after the other, NumPy."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _extract(
    config: Config,
    submap: Submap | None,
    first: int,
    matched: MatchedScans,
    scans: Scan,
) -> KeyframeChunk:
    """Start the front end on the keyframes of scans that begin at number `first` of the log."""
    own = matched.is_keyframe
    numbers = first + np.flatnonzero(own)
    odometry = keyframes.motion_since_keyframe(matched.odometry, own)[own]
    matches = None
    if matched.matches is not None:
        matches = keyframes.compose_matches(matched.matches, own)
    some = jax.tree.map(lambda x: x[numbers], scans)
    chunk = chunks.extract_matched(config, submap, odometry, some, matches)
    return KeyframeChunk(chunk, numbers, odometry, matched)


class _MatchedPart(NamedTuple):
    """Successive scans that are matched: the submap after them; whether they follow a break."""

    submap: Submap | None
    odometry: np.ndarray
    matches: ScanMatch | None
    starts_piece: bool = False
    across_break: np.ndarray | None = None


def _match_ahead(config: Config, submap: Submap | None, drive: Drive) -> Iterator[_MatchedPart]:
    """The scans of a drive, matched in chunks; those after a break begin with the empty submap."""
    starts = range(0, len(drive.odometry), chunks.CHUNK)
    if submap is None:
        for start in starts:
            yield _MatchedPart(None, drive.odometry[start : start + chunks.CHUNK], None)
        return

    latest, is_start = submap, drive.new_drive.copy()
    across: dict[int, np.ndarray] = {}
    has_shown = False  # whether the piece has a scan that shows a place
    is_start[0] = False
    num_returns = np.asarray(drive.scans.hit).sum(axis=1)

    def match(start: int) -> list[_MatchedPart]:
        nonlocal latest, has_shown
        found: list[_MatchedPart] = []
        stop = min(start + chunks.CHUNK, len(drive.odometry))
        while start < stop:
            new = np.flatnonzero(is_start[start + 1 : stop])
            some = slice(start, start + 1 + int(new[0]) if new.size else stop)
            increments, guessed = drive.odometry[some].copy(), drive.guessed[some].copy()
            if is_start[start]:
                latest, increments[0], guessed[0] = submap, 0.0, False
                has_shown = False
            scans = jax.tree.map(lambda x, some=some: x[some], drive.scans)
            after, matches = chunks.match_chunk(config, latest, increments, scans, guessed)
            shows = num_returns[some] >= breaks.MIN_RETURNS
            shown_before = has_shown | (np.cumsum(shows) > shows)
            may_break = shown_before & ~is_start[some]
            may_break[0] &= start > 0
            broken = breaks.first_break(
                matches,
                np.where(may_break, num_returns[some], 0),
                drive.after_pause[some],
                use_odometry=config.scan_matching.use_odometry,
            )
            count = len(increments)
            if broken is not None:
                is_start[start + broken], count = True, broken
                if matches.inlier_fraction[broken] >= breaks.PAUSE_INLIERS:
                    across[start + broken] = np.asarray(matches.increment[broken], float)
            if count:
                matches = jax.tree.map(lambda x, count=count: x[:count], matches)
                latest, has_shown = after, has_shown or bool(shows[:count].any())
                part = _MatchedPart(after, increments[:count], matches, is_start[start])
                found.append(part._replace(across_break=across.get(start)))
            start += count
        return found

    worker = ThreadPoolExecutor(1)
    try:
        run = chunks.with_settings(match)
        pending = deque(worker.submit(run, start) for start in starts)
        while pending:
            yield from pending.popleft().result()
    finally:
        worker.shutdown(cancel_futures=True)
