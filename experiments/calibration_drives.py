"""Drives of a robot with systematic errors, among landmarks whose measurements are exact but noisy.

The robot is the simulated one: it follows a path through a room, its wheels, its scanner's mount
and its clocks are off, and its encoders are noisy. The measurements are those of
`experiments.exact_model`: nearby landmarks with known data association, and the direction of the
walls, each with a draw of the filter's own measurement noise.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import exact_model
from jaxslam.core.episode import Episode
from jaxslam.core.types import JUNCTION, WALL, Array, Key
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.motion_model import wheel_coefficients
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config
from jaxslam.simulation import path_following, trial_episodes
from jaxslam.simulation.drives import drive, num_scans_of_drive
from jaxslam.simulation.robot import Robot

HURT = Robot(
    wheel_scales=(1.05, 0.97),
    wheel_base_scale=1.04,
    mount=(0.25, 0.05, float(np.deg2rad(3.0))),
    time_offset=0.08,
)
"""Wheels, base, mount and clocks that are off as far as those of a robot that nobody calibrated."""

ROOM = [(1.0, 1.0), (3.5, 1.0), (3.5, 2.5), (1.5, 2.5), (1.5, 4.0), (4.5, 4.0), (4.5, 1.5)]
"""Waypoints [m] of a drive with turns to both sides."""

LANDMARKS = np.array(
    [
        *([0.0, 0.0], [2.3, -0.2], [5.2, 0.1], [5.6, 2.2], [5.3, 4.8], [3.0, 5.0]),
        *([0.3, 5.2], [-0.4, 2.6], [2.5, 1.8], [2.6, 3.2], [0.6, 1.9], [4.0, 3.1]),
    ]
)
"""Positions (12, 2) [m]."""

CONFIG = Config(
    filter=FilterConfig(
        max_landmarks=len(LANDMARKS) + 1,
        max_updates=exact_model.MAX_SEEN + 1,
        max_new=exact_model.MAX_SEEN + 1,
        landmark_kinds=(JUNCTION, WALL),
    ),
)


def measurement_noise() -> NoiseParams:
    """The noise of `exact_model`, of the encoders of the calibrated robot `HURT`."""
    base = HURT.wheel_base * HURT.wheel_base_scale
    own = jnp.asarray(wheel_coefficients(base, HURT.encoder_noise), float)
    return exact_model.true_params()._replace(odometry_coefficients=own)


@partial(jax.jit, static_argnames=("robot", "num_trials", "num_scans"))
def _drives(
    key: Key, robot: Robot, path: Array, positions: Array, *, num_trials: int, num_scans: int
) -> Episode:
    params = measurement_noise()

    def one(key: Key) -> Episode:
        keys = jax.random.split(key)
        truth, odometry = drive(keys[0], robot, path, num_scans=num_scans)
        measure = jax.vmap(exact_model.measure, in_axes=(0, None, None, None, 0, 0))
        own = jax.random.split(keys[1], num_scans)
        measured = measure(own, params, positions, None, truth, odometry)
        return Episode(truth, odometry, *measured)

    return jax.lax.map(one, trial_episodes.trial_keys(key, jnp.arange(num_trials)))


def drives(
    key: Key, robot: Robot, *, num_trials: int, path: Any = ROOM, num_scans: int | None = None
) -> Episode:
    """B drives of a robot along a path, given by waypoints (K, 2) [m]; NumPy arrays."""
    points = jnp.asarray(path_following.densify(path), float)
    count = num_scans_of_drive(robot, points) if num_scans is None else num_scans
    positions = jnp.asarray(LANDMARKS, points.dtype)
    made = _drives(key, robot, points, positions, num_trials=num_trials, num_scans=count)
    return jax.tree.map(np.asarray, made)
