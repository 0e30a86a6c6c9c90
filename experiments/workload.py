"""Drives past landmarks that are told apart, and the filter that runs on them.

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

TOGETHER = 8  # runs filtered together: of 4, 8, 16, 32 the best for the gradient


class Drive(NamedTuple):
    """B runs of T steps; arrays may be NumPy's."""

    truth: Array  # (B, T, 3) pose after each step
    motion: Array  # (B, T, 3) odometry of each step
    polar: Array  # (B, T, M, 2) range [m] and bearing [rad] of what is seen
    who: Array  # (B, T, M) int32 landmark, -1 for none
    q: Array  # (B, 3, 3) covariance of the odometry
    r: Array  # (B, T, M, 2, 2) and of what is seen
    prior: Array  # (B, L, 2) where the landmarks are thought to be
    prior_cov: Array  # (B, L, 2, 2); zero where nothing is known


class Steps(NamedTuple):
    """What the filter says after each step."""

    pose: Array  # (T, 3)
    cov: Array  # (T, 3, 3)
    nis: Array  # (T,)
    dof: Array  # (T,) int32
    log_likelihood: Array  # (T,)
    good: Array  # (T,) bool, False where the update had to be left out


def wrap(angle: np.ndarray) -> np.ndarray:
    """The same angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def driven(first: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Poses (B, T, 3) after each of the motions (B, T, 3) from the poses `first` (B, 3)."""
    heading = first[:, None, 2] + np.cumsum(motion[..., 2], axis=1)
    before = np.concatenate([first[:, None, 2], heading[:, :-1]], axis=1)
    c, s = np.cos(before), np.sin(before)
    x, y = motion[..., 0], motion[..., 1]
    step = np.stack([c * x - s * y, s * x + c * y], axis=-1)
    return np.concatenate([first[:, None, :2] + np.cumsum(step, axis=1), heading[..., None]], -1)


def nearest(
    truth: np.ndarray, places: np.ndarray, within: tuple[float, float], most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range, bearing and landmark (B, T, most) of what is seen; -1 where there is nothing."""
    offset = places[:, None] - truth[:, :, None, :2]
    range_ = np.linalg.norm(offset, axis=-1)
    seen = (range_ > within[0]) & (range_ < within[1])
    index = np.argsort(np.where(seen, range_, np.inf), axis=-1)[..., :most]
    pick = partial(np.take_along_axis, indices=index, axis=-1)
    bearing = wrap(np.arctan2(offset[..., 1], offset[..., 0]) - truth[:, :, None, 2])
    return pick(range_), pick(bearing), np.where(pick(seen), index, -1).astype(np.int32)


def rings(
    seed: int, runs: int, *, odometry: float = 1.0, sensing: float = 1.0, prior: float = 0.5
) -> Drive:
    """200 steps past the nearest 8 of 32 landmarks within 6 m.

    The sensor has a least range of 0.4 m: what it measures as nearer it does not report.

    Args:
        seed: Of the draws.
        runs: B.
        odometry: Factor on the odometry noise of 2 cm, 2 cm and 0.01 rad a step.
        sensing: Factor on the sensor noise of 10 cm and 0.03 rad.
        prior: Standard deviation [m] to which each landmark is known beforehand; 0 if it is not.
    """
    rng, steps, count, most = np.random.default_rng(seed), 200, 32, 8
    angle = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    angle = angle[None] + rng.uniform(-0.08, 0.08, (runs, count))
    radius = np.where(np.arange(count) % 2 == 0, 2.6, 5.6) + rng.uniform(-0.6, 0.6, (runs, count))
    places = radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1) + [0.0, 4.0]
    phase = rng.uniform(0.0, 2 * np.pi, (runs, 1))
    turn = 0.25 * (0.25 + 0.10 * np.sin(0.07 * np.arange(steps)[None] + phase))
    true = np.stack([np.full_like(turn, 0.25), np.zeros_like(turn), turn], axis=-1)
    truth = driven(np.zeros((runs, 3)), true)
    q = odometry * np.array([0.02, 0.02, 0.01])
    r = sensing * np.array([0.10, 0.03])
    range_, bearing, who = nearest(truth, places, (0.4, 6.0), most)
    polar = np.stack([range_, bearing], axis=-1) + r * rng.normal(size=(*range_.shape, 2))
    who = np.where(polar[..., 0] > 0.4, who, -1)
    tile = lambda x, shape: np.broadcast_to(x, (*shape, *x.shape))
    return Drive(
        truth=truth,
        motion=true + q * rng.normal(size=true.shape),
        polar=polar,
        who=who,
        q=tile(np.diag(q**2), (runs,)),
        r=tile(np.diag(r**2), who.shape),
        prior=places + prior * rng.normal(size=places.shape),
        prior_cov=tile(prior**2 * np.eye(2), (runs, count)),
    )


def circle(seed: int, runs: int) -> Drive:
    """2500 poses on a circle among 20 landmarks of which nothing is known beforehand.

    The odometry alone is noisy, never the drive, which is the same in all runs. Landmarks are seen
    as positions in the frame of the robot, with 0.1 m of noise on each coordinate.
    """
    rng, steps, count, most = np.random.default_rng(seed), 2499, 20, 3
    speed, turn = 0.25, np.radians(1.5)
    radius = speed / turn
    angle = 2 * np.pi * np.arange(count) / count
    places = (radius + 3.0) * np.stack([np.cos(angle), np.sin(angle)], -1) + [0.0, radius]
    true = np.broadcast_to([speed, 0.0, turn], (1, steps, 3))
    truth = driven(np.zeros((1, 3)), true)
    range_, bearing, who = nearest(truth, places[None], (1.0, 5.0), most)
    away = np.where(who < 0, 1.0, range_)
    exact = away[..., None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    xy = exact + 0.1 * rng.normal(size=(runs, *exact.shape[1:]))
    polar = np.stack([np.hypot(xy[..., 0], xy[..., 1]), np.arctan2(xy[..., 1], xy[..., 0])], -1)
    q = np.array([0.05 * speed / np.sqrt(2), 0.0, 0.05 * speed * np.sqrt(2) * 2])
    tile = lambda x: np.broadcast_to(x, (runs, *x.shape))
    return Drive(
        truth=tile(truth[0]),
        motion=true + q * rng.normal(size=(runs, steps, 3)),
        polar=polar,
        who=tile(who[0]),
        q=tile(np.diag(q**2)),
        r=np.asarray(_polar_cov(jnp.asarray(xy), 0.01)),
        prior=tile(np.zeros((count, 2))),
        prior_cov=tile(np.zeros((count, 2, 2))),
    )


@jax.jit
def _polar_cov(xy: Array, variance: float) -> Array:
    """Covariances (..., 2, 2) of range and bearing of points (..., 2) of one variance."""
    cov = variance * jnp.eye(2, dtype=xy.dtype)
    flat = jax.vmap(measurement_model.polar_cov, in_axes=(0, None))(xy.reshape(-1, 2), cov)
    return flat.reshape(xy.shape + (2,))


def _start(linearisation: str, run: Drive) -> Belief:
    belief = initial_belief(jnp.zeros(3, run.motion.dtype), max_landmarks=run.prior.shape[0])
    belief = add_known_landmarks(belief, run.prior, run.prior_cov)
    given = jnp.any(run.prior_cov != 0.0, axis=(1, 2))
    return belief._replace(num_seen=jnp.where(given, 1, 0).astype(jnp.int32))


def step(
    linearisation: str, q: Array, belief: Belief, now: tuple[Array, ...], *, grows: bool = True
) -> tuple[Belief, Steps]:
    """One step, known association; what is seen first is taken in, if the map `grows`.

    Args:
        linearisation: One of `LINEARISATIONS`.
        q: (3, 3) covariance of the odometry.
        belief: After the step before.
        now: Odometry (3,), range and bearing (M, 2), whose they are (M,), covariances (M, 2, 2).
        grows: Whether there are landmarks that are not known beforehand.
    """
    how = {"linearisation": linearisation}
    motion, polar, who, r = now
    size = belief.num_seen.size
    belief = ekf.predict(belief, motion, q, **how)
    features = features_from_range_bearing(polar, who >= 0)
    known = (who >= 0) & (belief.num_seen.at[who].get(mode="fill", fill_value=0) > 0)
    rows = ekf.linearize(belief, features, r, jnp.where(known, who, size), **how)
    belief, done = ekf.update(belief, rows, **how)
    if grows:
        new, at = (who >= 0) & ~known, jnp.where(who >= 0, who, size)
        belief, _ = map_management.augment(
            belief, features, r, new, max_new=who.size, new_slot=at, **how
        )
    dof = 2 * jnp.sum(known, dtype=jnp.int32)
    likely = kalman.log_likelihood(done, dof)
    return belief, Steps(belief.pose, belief.pose_cov, done.nis, dof, likely, done.ok)


def filter_one(linearisation: str, run: Drive, *, grows: bool = True) -> Steps:
    """Filter one run by `step`."""
    body = partial(step, linearisation, run.q, grows=grows)
    data = run.motion, run.polar, run.who, run.r
    return lax.scan(body, _start(linearisation, run), data)[1]


@partial(jax.jit, static_argnums=0)
def filtered(linearisation: str, drive: Drive) -> Steps:
    """Filter B runs, a few together, which stay in the cache."""
    return map_batches(partial(filter_one, linearisation), drive, batch_size=TOGETHER)


def as_floats(drive: Drive, dtype: type = np.float32) -> Drive:
    """The drive on the device, in floating-point numbers of one size."""
    cast = lambda x: x.astype(dtype) if np.issubdtype(x.dtype, np.floating) else x
    return jax.tree.map(lambda x: jnp.asarray(cast(np.asarray(x))), drive)
