"""Drives for which the filter's model is exactly true, so that tuning has a right answer.

They go through the office. Odometry errs by a draw of its process noise. Up to six nearby
landmarks, with known data association, and the direction of the walls are measured with a draw of
the measurement noise. The landmarks are junctions, or corners, of which the walls are known too.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from experiments import common
from jaxslam.core.episode import Episode
from jaxslam.core.features import Features, zero_padding
from jaxslam.core.measurement import Measurement
from jaxslam.core.se2 import compose, wrap_angle, wrap_direction
from jaxslam.core.types import CORNER, JUNCTION, WALL, Array, Key
from jaxslam.filtering import motion_model
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.measurement_model import predict_measurement
from jaxslam.filtering.motion_model import wheel_coefficients
from jaxslam.filtering.noise import NoiseParams, measurement_cov
from jaxslam.pipeline.config import Config
from jaxslam.simulation import path_following, trial_episodes, worlds
from jaxslam.simulation.drives import start_pose
from jaxslam.simulation.robot import Robot

NUM_LANDMARKS = 40  # the next number is the direction of the walls
MAX_SEEN = 6  # of them in a scan
RANGE_MIN, RANGE_MAX = 0.7, 4.0  # [m] of a landmark that the robot sees
OWN_STD, OWN_WALL_STD = 0.004, 0.002  # [m], [rad] about which their own standard deviation is
CONFIG = Config(
    filter=FilterConfig(
        max_landmarks=NUM_LANDMARKS + 1,
        max_updates=MAX_SEEN + 1,
        max_new=MAX_SEEN + 1,
        landmark_kinds=(JUNCTION, WALL),
    ),
)
CORNER_CONFIG = CONFIG._replace(filter=CONFIG.filter._replace(landmark_kinds=(CORNER, WALL)))


def true_params() -> NoiseParams:
    """Q and R that the drives are simulated with."""
    return NoiseParams(
        odometry_coefficients=jnp.asarray(wheel_coefficients(*Robot()[:2]), float),
        range_std=jnp.asarray(0.01, float),
        bearing_std=jnp.asarray(0.005, float),
        feature_std_scale=jnp.asarray(1.0, float),
        wall_angle_std=jnp.asarray(0.002, float),
    )


def landmark_positions() -> np.ndarray:
    """Positions (NUM_LANDMARKS, 2) [m]: ends of the office's walls, as far apart as possible."""
    ends = np.unique(np.asarray(worlds.named("office").walls).reshape(-1, 2), axis=0)
    chosen, distance = [ends[0]], np.full(len(ends), np.inf)
    for _ in range(NUM_LANDMARKS - 1):
        distance = np.minimum(distance, np.linalg.norm(ends - chosen[-1], axis=1))
        chosen.append(ends[np.argmax(distance)])
    return np.array(chosen)


def landmark_walls() -> np.ndarray:
    """Directions (NUM_LANDMARKS, 2) [rad] in which two walls leave each landmark, world frame.

    Where one wall ends, both are the same.
    """
    walls = np.asarray(worlds.named("office").walls)
    starts = np.concatenate([walls[:, :2], walls[:, 2:]])
    along = np.concatenate([walls[:, 2:] - walls[:, :2], walls[:, :2] - walls[:, 2:]])
    angle = np.arctan2(along[:, 1], along[:, 0])
    own = [angle[(starts == position).all(axis=1)] for position in landmark_positions()]
    return np.array([[found[0], found[min(1, len(found) - 1)]] for found in own])


def _root(cov: Array) -> Array:
    """Lower triangle (n, n) L with L L^T = cov, which may be semi-definite."""
    eye = jnp.eye(len(cov), dtype=cov.dtype)
    return jnp.linalg.cholesky(cov + 1e-12 * eye)


def measure(
    key: Key,
    params: NoiseParams,
    positions: Array,
    walls: Array | None,
    pose: Array,
    odometry: Array,
) -> tuple[Features, Array]:
    """Noisy features at a pose (3,), and which landmark each is (MAX_SEEN + 1,).

    With the directions of their `walls` (NUM_LANDMARKS, 2) the landmarks are corners.
    """
    keys = jax.random.split(key, 2)
    distance = jnp.linalg.norm(positions - pose[None, :2], axis=1)
    sorted_by = jnp.where(distance > RANGE_MIN, distance, jnp.inf)
    order = jnp.argsort(sorted_by)[:MAX_SEEN].astype(jnp.int32)
    in_range = (distance[order] > RANGE_MIN) & (distance[order] < RANGE_MAX)
    valid = jnp.append(in_range, True)
    is_wall = jnp.arange(MAX_SEEN + 1, dtype=jnp.int32) == MAX_SEEN
    kind = jnp.where(is_wall, jnp.int32(WALL), jnp.int32(JUNCTION if walls is None else CORNER))
    own = jnp.concatenate([positions[order], jnp.zeros((1, 2), positions.dtype)])
    exact = jax.vmap(predict_measurement, in_axes=(None, 0, 0))(pose, own, kind)[0]
    # Their own covariances differ, so that the data determine the filter's parameters besides.
    scale = jnp.exp(jax.random.uniform(keys[0], (MAX_SEEN + 1,), pose.dtype, -1.2, 1.2))
    bisector, descriptor = jnp.zeros_like(scale), jnp.ones_like(scale)
    if walls is not None:
        free_side = jnp.mod(walls[order, 1] - walls[order, 0], 2 * jnp.pi)
        bisector = jnp.append(wrap_angle(walls[order, 0] + free_side / 2 - pose[2]), 0.0)
        descriptor = jnp.append(free_side, 0.0)

    def features(range_bearing: Array) -> Features:
        bearing = range_bearing[:, 1]
        xy = range_bearing[:, :1] * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)], axis=1)
        return Features(
            kind=kind,
            xy=jnp.where(is_wall[:, None], 0.0, xy),
            cov=(OWN_STD * scale)[:, None, None] ** 2 * jnp.eye(2, dtype=pose.dtype)[None],
            direction=jnp.where(is_wall, wrap_direction(range_bearing[:, 0]), bisector),
            direction_variance=(OWN_WALL_STD * scale) ** 2,
            descriptor=descriptor,
            degree=jnp.zeros(MAX_SEEN + 1, jnp.int32),
            certified=valid,
            trusted=valid,
            valid=valid,
        )

    noise_free = features(exact)
    R = measurement_cov(params, noise_free, Measurement(odometry, noise_free))
    roots = jax.vmap(_root)(R)
    error = jnp.einsum("mij,mj->mi", roots, jax.random.normal(keys[1], exact.shape, exact.dtype))
    one = jnp.ones_like(scale)  # a wall's direction is one number
    error = error * jnp.stack([one, jnp.where(is_wall, 0.0, one)], axis=1)
    ids = jnp.append(order, jnp.int32(len(positions)))
    return zero_padding(features(exact + error)), jnp.where(valid, ids, -1)


def drive(
    key: Key,
    params: NoiseParams,
    path: Array,
    positions: Array,
    walls: Array | None = None,
    *,
    num_scans: int,
) -> Episode:
    """One drive along a path (N, 2), steered by the true pose; `walls` as of `measure`."""

    def step(carry: tuple[Array, Array], key: Key) -> tuple[tuple[Array, Array], tuple]:
        pose, index = carry
        keys = jax.random.split(key)
        command, index = path_following.pure_pursuit(path, index, pose)
        root = _root(motion_model.odometry_cov(params.odometry_coefficients, command))
        increment = command + root @ jax.random.normal(keys[0], (3,), pose.dtype)
        pose = compose(pose, jnp.where(jnp.any(command != 0.0), increment, 0.0))
        return (pose, index), (
            pose,
            command,
            *measure(keys[1], params, positions, walls, pose, command),
        )

    first = start_pose(path)
    keys = jax.random.split(key, num_scans)
    rest = jnp.zeros(3, path.dtype)
    begin = first, rest, *measure(keys[0], params, positions, walls, first, rest)
    _, others = lax.scan(step, (first, jnp.int32(0)), keys[1:])
    whole = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), begin, others)
    return Episode(*whole)


@partial(jax.jit, static_argnames=("num_trials", "num_scans"))
def _drives(
    key: Key,
    params: NoiseParams,
    path: Array,
    positions: Array,
    walls: Array | None,
    *,
    num_trials: int,
    num_scans: int,
) -> Episode:
    keys = trial_episodes.trial_keys(key, jnp.arange(num_trials))
    one = partial(drive, num_scans=num_scans)
    return lax.map(lambda key: one(key, params, path, positions, walls), keys)


def drives(
    key: Key,
    params: NoiseParams,
    *,
    num_trials: int,
    num_scans: int | None = None,
    corners: bool = False,
) -> Episode:
    """B drives from S to F through the office, or their first scans; NumPy arrays.

    The landmarks are junctions, for `CONFIG`, or `corners`, for `CORNER_CONFIG`.
    """
    _, _, path, whole = common.drive_in()
    positions = jnp.asarray(landmark_positions(), path.dtype)
    walls = jnp.asarray(landmark_walls(), path.dtype) if corners else None
    count = whole if num_scans is None else num_scans
    simulated = _drives(key, params, path, positions, walls, num_trials=num_trials, num_scans=count)
    return jax.tree.map(np.asarray, simulated)
