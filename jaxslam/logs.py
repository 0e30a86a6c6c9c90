"""Convert recordings of real robots to the data that the filter takes: features, odometry, truth.

Features are extracted once, so that the filter can be run many times. Logs hold NumPy arrays: one
drive each or, stacked, B drives.
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

ROOM = 384, 1024  # capacity for landmarks with a laser scanner: least and most
SPARSE = 2.5  # [m] driven per landmark, for the capacity in between
CONFIRM = 3  # observations: clutter in real buildings is taken for a landmark once or twice
PART = 0.01  # standard deviation of a feature's own covariance per range; `Noise.scale` times it


def _features(config: Config, _: tuple, scan: Scan) -> Nodes:
    return slam.front_end(config, scan)


_SPREAD_FEATURES = Spread(_features, size=slam.BATCH, static=1)


def look(config: Config, scans: Scan) -> Nodes:
    """Extract the features [T] of scans [T], on all devices; NumPy arrays."""
    return _SPREAD_FEATURES(config, (), scans)


def config_of_scans(recordings: Sequence[Recording]) -> Config:
    """Default configuration for recordings by the same laser scanner.

    The capacity for landmarks is one per `SPARSE` metres of the longest trajectory, rounded up to
    a multiple of 128, within `ROOM`.
    """
    lengths = [
        np.hypot(*np.diff(recording.odometry[:, :2], axis=0).T).sum() for recording in recordings
    ]
    least, most = ROOM
    capacity = 128 * math.ceil(max(lengths) / SPARSE / 128)
    lidar = recordings[0].lidar
    return Config(lidar=lidar, landmarks=min(max(capacity, least), most), confirm=CONFIRM)


def from_recording(
    recording: Recording,
    config: Config,
    reference: tuple[np.ndarray, np.ndarray] | None = None,
    *,
    aligned: bool = False,
) -> Log:
    """Convert laser scans with odometry, from the first scan or the first that has a reference.

    Args:
        recording: T scans with odometry.
        config: Of the front end.
        reference: Times (N,) [s] on the recording's clock, and true poses (N, 3).
        aligned: Whether to add odometry increments by scan matching (`Config.alignment`).

    Raises:
        ValueError: No scan is at a time of the reference.
    """
    odometry = np.asarray(recording.odometry, np.float64)
    truth, truth_mask, begin = np.zeros_like(odometry), np.zeros(len(odometry), bool), 0
    if reference is not None:
        times, poses = reference
        i, j = match_times(recording.times, times).T
        if not i.size:
            raise ValueError("the reference has no pose at the time of a scan")
        truth[i], truth_mask[i], begin = poses[j], True, int(i.min())
    increments = motions(odometry[begin:])
    scans = lidar.limit(jnp.asarray(recording.ranges[begin:], float), config.lidar)
    matched = online.align(config, scans, increments) if aligned else None
    log = Log(
        truth=truth[begin:],
        motion=increments,
        nodes=look(config, scans),
        judged=truth_mask[begin:],
        aligned=matched,
    )
    return real(log)


def motions(poses: np.ndarray) -> np.ndarray:
    """Increments (T, 3) to each of poses (T, 3) from the one before, zero at the first."""
    return np.concatenate([np.zeros((1, 3)), seen_from(poses[:-1], poses[1:])])


def from_sightings(sightings: Sightings) -> Log:
    """Convert landmark measurements with known identities.

    The filter starts at the first reference pose, else at zero. A measurement of range r gets the
    covariance of a point along the beam with the standard deviation `PART` r. So `Noise.scale`
    counts percents of the range, in addition to `Noise.range` and `Noise.bearing`.
    """
    polar, valid = jnp.asarray(sightings.polar, float), jnp.asarray(sightings.valid)
    features = jax.vmap(from_polar, in_axes=(0, 0, None))(polar, valid, PART)
    log = Log(
        truth=sightings.truth,
        motion=sightings.motion,
        nodes=features,
        known=np.asarray(sightings.which, np.int32),
        judged=sightings.referenced,
    )
    return real(log)


def config_of(sightings: Sequence[Sightings]) -> Config:
    """Default configuration for landmark measurements: capacity for all of them, in every step.

    Updates use the invariant linearisation: with few, distant landmarks corrections of the heading
    are large.
    """
    most = max(robot.valid.shape[1] for robot in sightings)
    count = max(len(robot.names) for robot in sightings)
    return Config(
        kinds=(NODE,), linearisation="invariant", landmarks=count, matches=most, fresh=most
    )


def stack(logs: Sequence[Log]) -> Log:
    """Stack the logs of B drives; shorter ones are padded with scans without motion or features.

    Raises:
        ValueError: There are none, or some have `known` or `aligned` and others do not.
    """
    if not logs:
        raise ValueError("no logs")
    for name in ("known", "aligned"):
        if len({getattr(log, name) is None for log in logs}) > 1:
            raise ValueError(f"logs with and without `{name}` do not go together")
    scans = max(len(log.motion) for log in logs)
    features = max(log.nodes.valid.shape[1] for log in logs)

    def fill(x: np.ndarray, width: int | None = None, value: float = 0) -> np.ndarray:
        """Pad the scans of an array and, if a width is given, the features of each scan."""
        ends = [(0, scans - len(x))]
        ends += [] if width is None else [(0, width - x.shape[1])]
        ends += [(0, 0)] * (x.ndim - len(ends))
        return np.pad(x, ends, constant_values=value)

    padded = [
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
    return jax.tree.map(lambda *x: np.stack(x), *padded)


def real(log: Log) -> Log:
    """The log with NumPy arrays, floats in the precision of JAX (float32 unless x64 is on)."""
    precision = jnp.zeros(()).dtype

    def convert(x: np.ndarray) -> np.ndarray:
        x = np.asarray(x)
        return x.astype(precision) if x.dtype.kind == "f" else x

    return jax.tree.map(convert, log)
