"""A drive past landmarks with known identity, as a function of its noise: without a front end.

The robot drives along the paper's room. Odometry errs by a draw of its process noise; range and
bearing of up to six nearby landmarks by a draw of the measurement noise. So the error of the
filter, which knows both, grows little by little.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.episode import Episode
from jaxslam.core.se2 import compose, range_bearing, relative
from jaxslam.core.types import Array, Key
from jaxslam.filtering import motion_model
from jaxslam.filtering.motion_model import wheel_coefficients
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.features import features_from_range_bearing
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import filter_batch
from jaxslam.simulation import path_following
from jaxslam.simulation.drives import start_pose
from jaxslam.study.trials_from_noise import largest_error

NUM_SCANS, MAX_SEEN = 20, 6
RANGE_STD, BEARING_STD = 0.02, 0.01  # [m], [rad]
WAYPOINTS = (0.7, 0.8), (2.0, 1.0), (2.2, 2.3), (1.6, 3.6), (3.5, 4.2)
LANDMARKS = np.array([(x, y) for x in (0.0, 1.2, 2.7, 4.5) for y in (0.0, 1.6, 3.1, 5.0)])
CONFIG = Config.for_landmark_sensor(len(LANDMARKS), MAX_SEEN)
Noise = tuple[Array, Array]
"""Standard normals of the odometry [B], (T, 3), and of range and bearing (T, MAX_SEEN, 2)."""


def true_params() -> NoiseParams:
    """Q and R that the drives are simulated with."""
    return NoiseParams(
        odometry_coefficients=jnp.asarray(wheel_coefficients(0.4, 0.01), float),
        range_std=jnp.asarray(RANGE_STD, float),
        bearing_std=jnp.asarray(BEARING_STD, float),
        feature_std_scale=jnp.asarray(1e-3, float),  # the features' own share is nil
        wall_angle_std=jnp.asarray(0.002, float),
    )


@jax.jit
def draw(keys: Key) -> Noise:
    """Noise of trials with the keys (B,)."""

    def one(key: Key) -> Noise:
        of_odometry, of_features = jax.random.split(key)
        shape = NUM_SCANS, MAX_SEEN, 2
        return jax.random.normal(of_odometry, (NUM_SCANS, 3)), jax.random.normal(of_features, shape)

    return jax.vmap(one)(keys)


def simulate(params: NoiseParams, path: Array, landmarks: Array, noise: Noise) -> Episode:
    """One drive along a path (N, 2) past landmarks (L, 2)."""

    def move(carry: tuple[Array, Array], draws: Array) -> tuple[tuple[Array, Array], tuple]:
        pose, index = carry
        command, index = path_following.pure_pursuit(path, index, pose)
        cov = motion_model.odometry_cov(params.odometry_coefficients, command)
        root = jnp.linalg.cholesky(cov + 1e-10 * jnp.eye(3, dtype=cov.dtype))
        moved = compose(pose, command + root @ draws)
        return (moved, index), (moved, command)

    first = start_pose(path)
    _, (poses, commands) = lax.scan(move, (first, jnp.int32(0)), noise[0][1:])
    truth = jnp.concatenate([first[None], poses])
    odometry = jnp.pad(commands, ((1, 0), (0, 0)))

    def look(pose: Array, draws: Array) -> tuple:
        points = jnp.append(landmarks, jnp.zeros_like(landmarks[:, :1]), axis=1)
        own = jax.vmap(relative, in_axes=(None, 0))(pose, points)[:, :2]
        polar = jax.vmap(range_bearing)(own)
        near = jnp.argsort(polar[:, 0])[:MAX_SEEN].astype(jnp.int32)
        std = jnp.asarray([RANGE_STD, BEARING_STD], draws.dtype)
        measured = polar[near] + std[None] * draws
        seen = jnp.ones(MAX_SEEN, bool)
        return features_from_range_bearing(measured, seen, 0.01), near

    features, ids = jax.vmap(look)(truth, noise[1])
    return Episode(truth, odometry, features, ids)


@jax.jit
def score(noise: Noise) -> Array:
    """Largest position errors (B,) [m] of trials; NaN where one is not finite."""
    path = jnp.asarray(path_following.densify(np.array(WAYPOINTS)), float)
    params = true_params()
    one = partial(simulate, params, path, jnp.asarray(LANDMARKS, float))
    result = filter_batch(CONFIG.filter, params, jax.vmap(one)(noise))
    return jnp.where(result.finite, jax.vmap(largest_error)(result), jnp.nan)
