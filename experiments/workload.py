"""Drives past landmarks with known identity, and the filter that runs on them.

`rings`: two rings of landmarks about a wobbling loop, with a weak prior on each. `circle`: the
2-D SLAM benchmark of UKF-M (Brossard, Barrau, Bonnabel 2020, "A code for unscented Kalman
filtering on manifolds"), whose robot sees two or three of twenty landmarks at a time.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.batching import map_batches
from jaxslam.core.types import Array
from jaxslam.filtering import ekf, kalman, map_management, measurement_model
from jaxslam.filtering.belief import Belief, add_known_landmarks, initial_belief
from jaxslam.frontend.features import features_from_range_bearing

BATCH = 8  # trials filtered together: of 4, 8, 16, 32 the fastest for the gradient


class Drive(NamedTuple):
    """B trials of T steps; arrays may be NumPy's.

    Attributes:
        truth: (B, T, 3) true pose after each step.
        odometry: (B, T, 3) odometry increment of each step.
        range_bearing: (B, T, M, 2) [m, rad] measurements.
        landmark_ids: (B, T, M) int32 landmark of each measurement, -1 for none.
        odometry_cov: (B, 3, 3) covariance of the odometry.
        measurement_cov: (B, T, M, 2, 2) covariance of the measurements.
        prior: (B, L, 2) [m] prior positions of the landmarks.
        prior_cov: (B, L, 2, 2) [m^2] their covariances; zero where nothing is known.
    """

    truth: Array
    odometry: Array
    range_bearing: Array
    landmark_ids: Array
    odometry_cov: Array
    measurement_cov: Array
    prior: Array
    prior_cov: Array


class Steps(NamedTuple):
    """Output of the filter after each step.

    Attributes:
        pose: (T, 3) estimate.
        cov: (T, 3, 3) its covariance.
        nis: (T,) normalised innovation squared.
        dof: (T,) int32 degrees of freedom of the innovation.
        log_likelihood: (T,) of the innovation.
        ok: (T,) bool, False where the update had to be left out.
    """

    pose: Array
    cov: Array
    nis: Array
    dof: Array
    log_likelihood: Array
    ok: Array


def wrap(angle: np.ndarray) -> np.ndarray:
    """The same angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def dead_reckoning(first: np.ndarray, odometry: np.ndarray) -> np.ndarray:
    """Poses (B, T, 3) after each of the increments (B, T, 3) from the poses `first` (B, 3)."""
    heading = first[:, None, 2] + np.cumsum(odometry[..., 2], axis=1)
    before = np.concatenate([first[:, None, 2], heading[:, :-1]], axis=1)
    c, s = np.cos(before), np.sin(before)
    x, y = odometry[..., 0], odometry[..., 1]
    step = np.stack([c * x - s * y, s * x + c * y], axis=-1)
    return np.concatenate([first[:, None, :2] + np.cumsum(step, axis=1), heading[..., None]], -1)


TOGETHER = 32  # trials whose landmarks are sorted together


def nearest(
    truth: np.ndarray, positions: np.ndarray, within: tuple[float, float], count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range, bearing and index of the nearest landmarks (B, T, count); -1 where there is none.

    Args:
        truth: (B, T, 3) poses.
        positions: (B, L, 2) [m] of the landmarks.
        within: [m] least and largest range.
        count: Number of landmarks in a step at most.
    """
    positions = np.broadcast_to(positions, (len(truth), *positions.shape[1:]))
    shape = *truth.shape[:2], count
    distance, bearing, index = np.empty(shape), np.empty(shape), np.empty(shape, np.int32)
    for k in range(0, len(truth), TOGETHER):
        some = slice(k, k + TOGETHER)
        found = _nearest(truth[some], positions[some], within, count)
        distance[some], bearing[some], index[some] = found
    return distance, bearing, index


def _nearest(
    truth: np.ndarray, positions: np.ndarray, within: tuple[float, float], count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`nearest` of a few trials, as its arrays of all landmarks at all poses are large."""
    offset = positions[:, None] - truth[:, :, None, :2]
    distance = np.linalg.norm(offset, axis=-1)
    visible = (distance > within[0]) & (distance < within[1])
    index = np.argsort(np.where(visible, distance, np.inf), axis=-1)[..., :count]
    pick = partial(np.take_along_axis, indices=index, axis=-1)
    bearing = wrap(np.arctan2(offset[..., 1], offset[..., 0]) - truth[:, :, None, 2])
    return pick(distance), pick(bearing), np.where(pick(visible), index, -1).astype(np.int32)


def rings(
    seed: int,
    num_trials: int,
    *,
    odometry_scale: float = 1.0,
    sensor_scale: float = 1.0,
    prior_std: float = 0.5,
) -> Drive:
    """200 steps past the nearest 8 of 32 landmarks within 6 m.

    The sensor has a least range of 0.4 m: it does not report shorter measured ranges.

    Args:
        seed: Of the draws.
        num_trials: B.
        odometry_scale: Factor on the odometry noise of 2 cm, 2 cm and 0.01 rad a step.
        sensor_scale: Factor on the sensor noise of 10 cm and 0.03 rad.
        prior_std: [m] standard deviation of the prior of each landmark; 0 if there is no prior.
    """
    rng, steps, count = np.random.default_rng(seed), 200, 32
    angle = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    angle = angle[None] + rng.uniform(-0.08, 0.08, (num_trials, count))
    radius = np.where(np.arange(count) % 2 == 0, 2.6, 5.6) + rng.uniform(
        -0.6, 0.6, (num_trials, count)
    )
    positions = radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1) + [0.0, 4.0]
    phase = rng.uniform(0.0, 2 * np.pi, (num_trials, 1))
    turn = 0.25 * (0.25 + 0.10 * np.sin(0.07 * np.arange(steps)[None] + phase))
    true = np.stack([np.full_like(turn, 0.25), np.zeros_like(turn), turn], axis=-1)
    truth = dead_reckoning(np.zeros((num_trials, 3)), true)
    q = odometry_scale * np.array([0.02, 0.02, 0.01])
    r = sensor_scale * np.array([0.10, 0.03])
    distance, bearing, ids = nearest(truth, positions, (0.4, 6.0), 8)
    range_bearing = np.stack([distance, bearing], axis=-1)
    noise = rng.normal(size=range_bearing.shape)
    range_bearing += np.multiply(r, noise, out=noise)
    ids = np.where(range_bearing[..., 0] > 0.4, ids, -1)
    return Drive(
        truth=truth,
        odometry=true + q * rng.normal(size=true.shape),
        range_bearing=range_bearing,
        landmark_ids=ids,
        odometry_cov=_tile(np.diag(q**2), num_trials),
        measurement_cov=_tile(np.diag(r**2), *ids.shape),
        prior=positions + prior_std * rng.normal(size=positions.shape),
        prior_cov=_tile(prior_std**2 * np.eye(2), num_trials, count),
    )


def _tile(x: np.ndarray, *shape: int) -> np.ndarray:
    """The array repeated along new leading axes."""
    return np.broadcast_to(x, (*shape, *x.shape))


def circle(seed: int, num_trials: int) -> Drive:
    """2500 poses on a circle among 20 landmarks without a prior.

    Only the odometry is noisy, not the drive, which is the same in all trials. Landmarks are
    measured as positions in the base_link frame, with 0.1 m of noise on each coordinate.
    """
    rng, steps, count = np.random.default_rng(seed), 2499, 20
    speed, turn = 0.25, np.radians(1.5)
    radius = speed / turn
    angle = 2 * np.pi * np.arange(count) / count
    positions = (radius + 3.0) * np.stack([np.cos(angle), np.sin(angle)], -1) + [0.0, radius]
    true = np.broadcast_to([speed, 0.0, turn], (1, steps, 3))
    truth = dead_reckoning(np.zeros((1, 3)), true)
    distance, bearing, ids = nearest(truth, positions[None], (1.0, 5.0), 3)
    distance = np.where(ids < 0, 1.0, distance)
    exact = distance[..., None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    xy = exact + 0.1 * rng.normal(size=(num_trials, *exact.shape[1:]))
    bearing = np.arctan2(xy[..., 1], xy[..., 0])
    range_bearing = np.stack([np.hypot(xy[..., 0], xy[..., 1]), bearing], -1)
    q = np.array([0.05 * speed / np.sqrt(2), 0.0, 0.05 * speed * np.sqrt(2) * 2])
    return Drive(
        truth=_tile(truth[0], num_trials),
        odometry=true + q * rng.normal(size=(num_trials, steps, 3)),
        range_bearing=range_bearing,
        landmark_ids=_tile(ids[0], num_trials),
        odometry_cov=_tile(np.diag(q**2), num_trials),
        measurement_cov=np.asarray(_polar_cov(jnp.asarray(xy), 0.01)),
        prior=_tile(np.zeros((count, 2)), num_trials),
        prior_cov=_tile(np.zeros((count, 2, 2)), num_trials),
    )


@jax.jit
def _polar_cov(xy: Array, variance: float) -> Array:
    """Covariances (..., 2, 2) of range and bearing of points (..., 2) of one variance."""
    cov = variance * jnp.eye(2, dtype=xy.dtype)
    flat = jax.vmap(measurement_model.polar_cov, in_axes=(0, None))(xy.reshape(-1, 2), cov)
    return flat.reshape(xy.shape + (2,))


def _initial_belief(trial: Drive) -> Belief:
    belief = initial_belief(jnp.zeros(3, trial.odometry.dtype), max_landmarks=trial.prior.shape[0])
    belief = add_known_landmarks(belief, trial.prior, trial.prior_cov)
    has_prior = jnp.any(trial.prior_cov != 0.0, axis=(1, 2))
    return belief._replace(num_seen=jnp.where(has_prior, 1, 0).astype(jnp.int32))


def step(
    linearisation: str,
    odometry_cov: Array,
    belief: Belief,
    measurement: tuple[Array, Array, Array, Array],
    *,
    has_prior: bool = False,
) -> tuple[Belief, Steps]:
    """One step of the filter with known data association.

    Args:
        linearisation: One of `ekf.LINEARISATIONS`.
        odometry_cov: (3, 3) covariance of the odometry.
        belief: After the step before.
        measurement: Odometry (3,), range and bearing (M, 2), landmark ids (M,), covariances
            (M, 2, 2).
        has_prior: Whether all landmarks have a prior, so that none has to be added to the map.
    """
    odometry, range_bearing, ids, R = measurement
    size = belief.num_seen.size
    belief = ekf.predict(belief, odometry, odometry_cov, linearisation=linearisation)
    features = features_from_range_bearing(range_bearing, ids >= 0)
    in_map = (ids >= 0) & (belief.num_seen.at[ids].get(mode="fill", fill_value=0) > 0)
    slots = jnp.where(in_map, ids, size)
    linearized = ekf.linearize(belief, features, R, slots, linearisation=linearisation)
    belief, result = ekf.update(belief, linearized, linearisation=linearisation)
    if not has_prior:
        belief, _ = map_management.augment(
            belief,
            features,
            R,
            (ids >= 0) & ~in_map,
            max_new=ids.size,
            new_slot=jnp.where(ids >= 0, ids, size),
            linearisation=linearisation,
        )
    dof = 2 * jnp.sum(in_map, dtype=jnp.int32)
    log_likelihood = kalman.log_likelihood(result, dof)
    return belief, Steps(belief.pose, belief.pose_cov, result.nis, dof, log_likelihood, result.ok)


def filter_trial(linearisation: str, trial: Drive, *, has_prior: bool = False) -> Steps:
    """Filter one trial by `step`."""
    body = partial(step, linearisation, trial.odometry_cov, has_prior=has_prior)
    data = trial.odometry, trial.range_bearing, trial.landmark_ids, trial.measurement_cov
    return lax.scan(body, _initial_belief(trial), data)[1]


@partial(jax.jit, static_argnums=0)
def filter_drive(linearisation: str, drive: Drive) -> Steps:
    """Filter B trials, a few together, which stay in the cache."""
    return map_batches(partial(filter_trial, linearisation), drive, batch_size=BATCH)


def first_steps(drive: Drive, count: int) -> Drive:
    """The first steps of all trials."""
    return drive._replace(
        truth=drive.truth[:, :count],
        odometry=drive.odometry[:, :count],
        range_bearing=drive.range_bearing[:, :count],
        landmark_ids=drive.landmark_ids[:, :count],
        measurement_cov=drive.measurement_cov[:, :count],
    )


def as_floats(drive: Drive, dtype: type = np.float32) -> Drive:
    """The drive on the device, in floating-point numbers of one size."""

    def convert(x: Array) -> Array:
        x = np.asarray(x)
        return jnp.asarray(x.astype(dtype) if np.issubdtype(x.dtype, np.floating) else x)

    return jax.tree.map(convert, drive)
