"""Localisation of a recorded log in a saved map, scan by scan."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.localisation import localise
from jaxslam.localisation.config import LocaliseInfo, LocaliseSpec, PlaceMap
from jaxslam.matching import scan_matching
from jaxslam.pipeline import chunks, odometry_notes
from jaxslam.pipeline.log_input import LogInput

WHEEL_STD_FLOOR, WHEEL_SLIP = (0.03, 0.02), (0.1, 0.2)
"""Of `LocaliseSpec`, where odometry is that of the wheels alone."""


class LogLocalisation(NamedTuple):
    """Where the robot was at each of T scans, NumPy.

    Attributes:
        infos: [T] results of `localise.step`.
        increments: (T, 3) [m, m, rad] motion since the scan before.
        notes: What was wrong with the odometry.
    """

    infos: LocaliseInfo
    increments: np.ndarray
    notes: tuple[str, ...]


def spec_for_log(given: LogInput) -> LocaliseSpec:
    """Options of localisation for the odometry of a log."""
    if given.match_scans:
        return LocaliseSpec()
    return LocaliseSpec(odometry_std_floor=WHEEL_STD_FLOOR, odometry_slip=WHEEL_SLIP)


def localise_log(
    spec: LocaliseSpec,
    place_map: PlaceMap,
    given: LogInput,
    pose: Any = None,
    *,
    callback: Callable[[LocaliseInfo], Any] | None = None,
) -> LogLocalisation:
    """Localise the robot of a log in a map, by what is known up to each scan.

    Latched odometry is the one exception: its leaps are shared out over the few scans before them.

    Args:
        spec: Options.
        place_map: By `localise.make_map`.
        given: The log.
        pose: (3,) [m, m, rad] of the scanner at the first scan, map frame, about; None: anywhere.
        callback: Called after each chunk of scans with its results [N], NumPy.

    Raises:
        ValueError: An option is out of range, or `pose` is not a finite pose.
    """
    lidar, config = given.config.frontend.lidar, given.config
    scans = jax.tree.map(np.asarray, given.scans)
    increments, submap = given.increments, None
    notes: tuple[str, ...] = ()
    guessed = np.zeros(len(increments), bool) if given.guessed is None else given.guessed
    if given.match_scans:
        submap = scan_matching.empty_submap(config.scan_matching, lidar)
        if config.scan_matching.use_odometry:
            increments, is_share, notes = odometry_notes.share_out(
                increments, scans, given.after_pause
            )
            guessed = guessed | is_share
        else:
            increments = np.zeros_like(increments)
    state, found, motion = localise.init(spec, lidar, pose), [], []
    for first in range(0, len(increments), chunks.CHUNK):
        odometry, some = chunks.chunk_at(first, increments, scans)
        if submap is not None:
            own = guessed[first : first + chunks.CHUNK]
            submap, matches = chunks.match_chunk(config, submap, odometry, some, own)
            odometry = np.asarray(matches.increment)
        padded = chunks.padded_chunk(odometry, some)
        state, infos = localise.run_steps(spec, lidar, place_map, state, *padded)
        found.append(jax.tree.map(lambda x: np.asarray(x)[: len(odometry)], infos))  # noqa: B023
        motion.append(odometry)
        if callback is not None:
            callback(found[-1])
    infos = jax.tree.map(lambda *x: np.concatenate(x), *found)
    return LogLocalisation(infos, np.concatenate(motion), notes)
