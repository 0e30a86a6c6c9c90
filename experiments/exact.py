"""Drives for which the filter's model is exactly true, so that tuning has a right answer.

They go through the office. Odometry errs by a draw of its process noise. Up to six landmarks near
by, which are told apart, and the direction of the walls are seen with a draw of the sensor noise.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from experiments import common
from jaxslam.core.episode import Episode
from jaxslam.core.features import Features, zero_padding
from jaxslam.core.se2 import compose, wrap_direction
from jaxslam.core.types import JUNCTION, WALL, Array, Key
from jaxslam.filtering import motion_model
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.measurement_model import predict_measurement
from jaxslam.filtering.motion_model import wheel_coefficients
from jaxslam.filtering.noise import NoiseParams, measurement_cov
from jaxslam.pipeline.config import Config
from jaxslam.simulation import path_following, trials, worlds
from jaxslam.simulation.drives import start_pose
from jaxslam.simulation.robot import Robot

PLACES = 40  # landmarks; the next number is the direction of the walls
SEEN = 6  # of them in a scan at most
NEAR, FAR = 0.7, 4.0  # [m] from which to which the robot sees them
OWN, OWN_WALL = 0.004, 0.002  # [m], [rad] about which their own standard deviation is
CONFIG = Config(
    filter=FilterConfig(
        max_landmarks=PLACES + 1,
        max_updates=SEEN + 1,
        max_new=SEEN + 1,
        landmark_kinds=(JUNCTION, WALL),
    ),
)


def truth() -> NoiseParams:
    """The noise that the drives are made with."""
    odometry = wheel_coefficients(*Robot())
    rest = {"range": 0.01, "bearing": 0.005, "scale": 1.0, "wall": 0.002}
    return NoiseParams(
        jnp.asarray(odometry, float), *(jnp.asarray(x, float) for x in rest.values())
    )


def marks() -> np.ndarray:
    """Landmarks (PLACES, 2) [m]: ends of the office's walls, as far apart as may be."""
    ends = np.unique(np.asarray(worlds.named("office").walls).reshape(-1, 2), axis=0)
    chosen, gap = [ends[0]], np.full(len(ends), np.inf)
    for _ in range(PLACES - 1):
        gap = np.minimum(gap, np.linalg.norm(ends - chosen[-1], axis=1))
        chosen.append(ends[np.argmax(gap)])
    return np.array(chosen)


def _root(cov: Array) -> Array:
    """Lower triangle (n, n) L with L L^T = cov, which may be semi-definite."""
    eye = jnp.eye(len(cov), dtype=cov.dtype)
    return jnp.linalg.cholesky(cov + 1e-12 * eye)


def see(key: Key, noise: NoiseParams, places: Array, pose: Array) -> tuple[Features, Array]:
    """What the robot sees from a pose (3,): features, and which landmark each is (SEEN + 1,)."""
    keys = jax.random.split(key, 2)
    away = jnp.linalg.norm(places - pose[None, :2], axis=1)
    order = jnp.argsort(jnp.where(away > NEAR, away, jnp.inf))[:SEEN].astype(jnp.int32)
    valid = jnp.append((away[order] > NEAR) & (away[order] < FAR), True)
    kind = jnp.append(jnp.full(SEEN, JUNCTION, jnp.int32), jnp.int32(WALL))
    spots = jnp.concatenate([places[order], jnp.zeros((1, 2), places.dtype)])
    exact = jax.vmap(predict_measurement, in_axes=(None, 0, 0))(pose, spots, kind)[0]
    # Their own covariance differs from one to the next: it and the rest can be told apart.
    wide = jnp.exp(jax.random.uniform(keys[0], (SEEN + 1,), pose.dtype, -1.2, 1.2))

    def features(polar: Array) -> Features:
        xy = polar[:, :1] * jnp.stack([jnp.cos(polar[:, 1]), jnp.sin(polar[:, 1])], axis=1)
        zero = jnp.zeros_like(wide)
        return Features(
            kind=kind,
            xy=jnp.where((kind == WALL)[:, None], 0.0, xy),
            cov=(OWN * wide)[:, None, None] ** 2 * jnp.eye(2, dtype=pose.dtype)[None],
            direction=jnp.where(kind == WALL, wrap_direction(polar[:, 0]), 0.0),
            direction_variance=(OWN_WALL * wide) ** 2,
            descriptor=zero + 1.0,
            degree=jnp.zeros(SEEN + 1, jnp.int32),
            certified=valid,
            trusted=valid,
            valid=valid,
        )

    spread = jax.vmap(_root)(measurement_cov(noise, features(exact)))
    error = jnp.einsum("mij,mj->mi", spread, jax.random.normal(keys[1], exact.shape, exact.dtype))
    one = jnp.ones_like(wide)  # a wall's direction is one number
    error = error * jnp.stack([one, jnp.where(kind == JUNCTION, one, 0.0)], axis=1)
    who = jnp.append(order, jnp.int32(PLACES))
    return zero_padding(features(exact + error)), jnp.where(valid, who, -1)


def drive(key: Key, noise: NoiseParams, path: Array, places: Array, *, steps: int) -> Episode:
    """One drive along a path (N, 2), steered by the true pose."""

    def body(now: tuple[Array, Array], key: Key) -> tuple[tuple[Array, Array], tuple]:
        pose, place = now
        keys = jax.random.split(key)
        told, place = path_following.pure_pursuit(path, place, pose)
        slip = _root(motion_model.odometry_cov(noise.odometry_coefficients, told))
        moved = told + slip @ jax.random.normal(keys[0], (3,), pose.dtype)
        moves = jnp.any(told != 0.0)
        pose = compose(pose, jnp.where(moves, moved, 0.0))
        return (pose, place), (pose, told, *see(keys[1], noise, places, pose))

    first = start_pose(path)
    keys = jax.random.split(key, steps)
    begin = first, jnp.zeros(3, path.dtype), *see(keys[0], noise, places, first)
    _, rest = lax.scan(body, (first, jnp.int32(0)), keys[1:])
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), begin, rest)
    return Episode(*whole)


@partial(jax.jit, static_argnames=("runs", "steps"))
def _drives(
    key: Key, noise: NoiseParams, path: Array, places: Array, *, runs: int, steps: int
) -> Episode:
    keys = trials.trial_keys(key, jnp.arange(runs))
    return lax.map(lambda key: drive(key, noise, path, places, steps=steps), keys)


def drives(key: Key, noise: NoiseParams, *, runs: int, steps: int | None = None) -> Episode:
    """B drives from S to F through the office, or their first steps; NumPy arrays."""
    _, robot, path, scans = common.scene()
    places = jnp.asarray(marks(), path.dtype)
    made = _drives(key, noise, path, places, runs=runs, steps=scans if steps is None else steps)
    return jax.tree.map(np.asarray, made)
