"""Recorded drives as logs that the filter is run on: features once, the filter as often as wanted.

Logs of NumPy arrays, one run each or, stacked, of B runs that lead them.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import lidar, online, slam
from jaxslam.batches import Spread
from jaxslam.io.recording import Recording, Sightings
from jaxslam.lidar import Scan
from jaxslam.metrics import match_times
from jaxslam.monte_carlo import Log
from jaxslam.nodes import Nodes, from_polar
from jaxslam.poses import seen_from
from jaxslam.slam import Config
from jaxslam.types import NODE

ROOM = 384, 1024  # landmarks that there is room for in a log of scans: at least, at most
SPARSE = 2.5  # [m] of the way for which there is room for a landmark, in between
CONFIRM = 3  # sightings: real buildings have clutter that looks like a landmark once or twice
PART = 0.01  # what a sighting's own standard deviation is of its range; `Noise.scale` times that


def _look(config: Config, _: tuple, scan: Scan) -> Nodes:
    return slam.front_end(config, scan)


_LOOK = Spread(_look, size=slam.BATCH, static=1)


def look(config: Config, scans: Scan) -> Nodes:
    """Features [T] of scans [T], NumPy arrays, with all devices."""
    return _LOOK(config, (), scans)


def config_of_scans(recordings: Sequence[Recording]) -> Config:
    """What logs of laser scans, all by the same scanner, are filtered with unless told otherwise.

    There is room for the landmarks of the longest way, in steps of 128.
    """
    ways = [np.hypot(*np.diff(one.odometry[:, :2], axis=0).T).sum() for one in recordings]
    least, most = ROOM
    room = 128 * math.ceil(max(ways) / SPARSE / 128)
    lidar = recordings[0].lidar
    return Config(lidar=lidar, landmarks=min(max(room, least), most), confirm=CONFIRM)


def from_recording(
    recording: Recording,
    config: Config,
    reference: tuple[np.ndarray, np.ndarray] | None = None,
    *,
    aligned: bool = False,
) -> Log:
    """A log of laser scans, from its first scan or the first that has a reference.

    Args:
        recording: T scans with wheel odometry.
        config: Of the front end.
        reference: Times (N,) [s] and poses (N, 3) on the log's clock.
        aligned: Whether scans are aligned, as `Config.alignment` says, and fused with the wheels.

    Raises:
        ValueError: No scan is at a time of the reference.
    """
    wheels = np.asarray(recording.odometry, np.float64)
    truth, judged, begin = np.zeros_like(wheels), np.zeros(len(wheels), bool), 0
    if reference is not None:
        i, j = match_times(recording.times, reference[0]).T
        if not i.size:
            raise ValueError("the reference has no pose at the time of a scan")
        truth[i], judged[i], begin = reference[1][j], True, int(i.min())
    wheels, truth, judged = wheels[begin:], truth[begin:], judged[begin:]
    motion = motions(wheels)
    scans = lidar.limit(jnp.asarray(recording.ranges[begin:], float), config.lidar)
    by_scans = online.align(config, scans, motion) if aligned else None
    return real(Log(truth, motion, look(config, scans), None, judged, aligned=by_scans))


def motions(poses: np.ndarray) -> np.ndarray:
    """Motion (T, 3) from each of poses (T, 3) to the next, zero at the first."""
    return np.concatenate([np.zeros((1, 3)), seen_from(poses[:-1], poses[1:])])


def from_sightings(sightings: Sightings) -> Log:
    """A log of landmarks that are told apart; it starts at its first reference, else at zero.

    A sighting's own covariance is that of a range good to `PART` of it, so that `Noise.scale`
    counts percents of the range, beside `Noise.range` and `Noise.bearing`.
    """
    polar, valid = jnp.asarray(sightings.polar, float), jnp.asarray(sightings.valid)
    seen = jax.vmap(from_polar, in_axes=(0, 0, None))(polar, valid, PART)
    known = np.asarray(sightings.which, np.int32)
    return real(Log(sightings.truth, sightings.motion, seen, known, sightings.referenced))


def config_of(sightings: Sequence[Sightings]) -> Config:
    """A filter with room for all landmarks of the sightings, and for all that are seen at once.

    Few landmarks that are far off turn the heading far: its linearisation is the invariant one.
    """
    most = max(one.valid.shape[1] for one in sightings)
    count = max(len(one.names) for one in sightings)
    sizes = {"landmarks": count, "matches": most, "fresh": most}
    return Config(kinds=(NODE,), linearisation="invariant", **sizes)


def stack(logs: Sequence[Log]) -> Log:
    """Logs of B drives as one; shorter ones stand still, blind, at their end.

    Raises:
        ValueError: There are none, or some know their landmarks, or have their scans aligned, and
            some do not.
    """
    if not logs:
        raise ValueError("no logs")
    for name in ("known", "aligned"):
        if len({getattr(log, name) is None for log in logs}) > 1:
            raise ValueError(f"logs with and without `{name}` do not go together")
    steps = max(len(log.motion) for log in logs)
    features = max(log.nodes.valid.shape[1] for log in logs)

    def fill(x: np.ndarray, features: int | None = None, value: float = 0) -> np.ndarray:
        ends = [(0, steps - len(x))]
        ends += [] if features is None else [(0, features - x.shape[1])]
        ends += [(0, 0)] * (x.ndim - len(ends))
        return np.pad(x, ends, constant_values=value)

    long = [
        Log(
            truth=fill(log.truth),
            motion=fill(log.motion),
            nodes=jax.tree.map(lambda x: fill(np.asarray(x), features), log.nodes),
            known=None if log.known is None else fill(log.known, features, -1),
            judged=fill(np.ones(len(log.truth), bool) if log.judged is None else log.judged),
            length=np.int32(len(log.truth)),
            aligned=jax.tree.map(lambda x: fill(np.asarray(x)), log.aligned),
        )
        for log in logs
    ]
    return jax.tree.map(lambda *x: np.stack(x), *long)


def real(log: Log) -> Log:
    """The log in NumPy arrays, of the precision that JAX works in."""
    precision = jnp.zeros(()).dtype

    def convert(x: np.ndarray) -> np.ndarray:
        x = np.asarray(x)
        return x.astype(precision) if x.dtype.kind == "f" else x

    return jax.tree.map(convert, log)
