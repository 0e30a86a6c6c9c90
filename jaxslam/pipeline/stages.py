"""Stages of a whole log: scan matching runs ahead, and its keyframes are gathered to chunks.

Every scan is matched, in chunks of `CHUNK` scans. Features, arcs and filter work on keyframes
alone, in chunks of `CHUNK` keyframes: so their programs have the shapes of all others, however many
scans are between two keyframes.

    time --->
    worker       | matching 0 | matching 1 | matching 2 | matching 3 | ...
    keyframes                              ^ CHUNK of them            ^ CHUNK more
    front end                              | features 0 |            | features 1 |
    filter                                                           | filter 0   | filter 1 | ...

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
from jaxslam.pipeline import chunks, keyframes
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
    """

    chunk: Chunk
    keyframes: np.ndarray
    odometry: np.ndarray
    matched: MatchedScans


def keyframe_chunks(
    config: Config,
    submap: Submap | None,
    odometry: np.ndarray,
    scans: Scan,
    guessed: np.ndarray,
) -> Generator[KeyframeChunk]:
    """Match the scans of a log, and extract features and arcs of its keyframes, chunk by chunk.

    Keyframes are chosen by `config.keyframe_distance`; the last scan of the log is one, too. Close
    the iterator to stop the worker thread.

    Args:
        config: Of front end, scan matching and keyframes.
        submap: Of the scan matcher; None where scans are not matched: all are keyframes.
        odometry: (T, 3) [m, m, rad] increments, NumPy.
        scans: [T], NumPy.
        guessed: (T,) bool, which increments are guesses of the reader.
    """
    first, num_matched, before, waiting = 0, 0, None, None
    for after, odometry_of_some, matches in _match_ahead(config, submap, odometry, scans, guessed):
        matched = MatchedScans(np.ones(len(odometry_of_some), bool), odometry_of_some, matches)
        if matches is not None:
            is_keyframe, before = keyframes.choose_keyframes(
                config.keyframe_distance, matched.increments, before
            )
            matched = matched._replace(is_keyframe=is_keyframe)
        num_matched += len(odometry_of_some)
        at_end = num_matched == len(odometry)
        matched.is_keyframe[-1] |= at_end
        waiting = matched if waiting is None else concatenate([waiting, matched])
        ends = np.flatnonzero(waiting.is_keyframe) + 1
        complete = len(ends) if at_end else len(ends) // chunks.CHUNK * chunks.CHUNK
        start = 0
        for k in range(0, complete, chunks.CHUNK):
            end = int(ends[k : k + chunks.CHUNK][-1])
            yield _extract(config, after, first + start, _part(waiting, start, end), scans)
            start = end
        first, waiting = first + start, _part(waiting, start, None)


def _part(matched: MatchedScans, start: int, end: int | None) -> MatchedScans:
    """The scans from number `start` up to, without, `end`."""
    return jax.tree.map(lambda x: x[start:end], matched)


def concatenate(parts: list[Any]) -> Any:
    """Arrays of several records that lead with scans, one after the other, NumPy."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _extract(
    config: Config, submap: Submap | None, first: int, matched: MatchedScans, scans: Scan
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


def _match_ahead(
    config: Config,
    submap: Submap | None,
    odometry: np.ndarray,
    scans: Scan,
    guessed: np.ndarray,
) -> Iterator[tuple[Submap | None, np.ndarray, ScanMatch | None]]:
    """For each chunk of scans the submap after it, its odometry (N, 3) and its matches [N]."""
    starts = range(0, len(odometry), chunks.CHUNK)
    if submap is None:
        for start in starts:
            yield None, odometry[start : start + chunks.CHUNK], None
        return

    latest = submap

    def match(start: int) -> tuple[Submap, np.ndarray, ScanMatch]:
        nonlocal latest
        increments, some = chunks.chunk_at(start, odometry, scans)
        some_guessed = guessed[start : start + chunks.CHUNK]
        latest, matches = chunks.match_chunk(config, latest, increments, some, some_guessed)
        return latest, increments, matches

    worker = ThreadPoolExecutor(1)
    try:
        run = chunks.with_settings(match)
        pending = deque(worker.submit(run, start) for start in starts)
        while pending:
            yield pending.popleft().result()
    finally:
        worker.shutdown(cancel_futures=True)
