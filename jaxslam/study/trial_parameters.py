"""Errors of trials as a function of parameters of the robot, its building and its filter.

The drive of a trial, its odometry and the filter are smooth in the noise of the encoders, the mount
and the noise that the filter assumes. The front end is not: its grid is discrete. Gradients hold
the errors of the features fixed, as they are in the frame of the scanner, and data association. By
them the features move with the scanner.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.devices import DeviceMap
from jaxslam.core.episode import Episode
from jaxslam.core.features import Features, restrict_features
from jaxslam.core.se2 import relative, rotation, wrap_angle, wrap_direction
from jaxslam.core.types import WALL, Array
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.pipeline.episodes import TrialResult, filter_batch, filter_episode
from jaxslam.simulation import drives
from jaxslam.simulation.life import Life
from jaxslam.simulation.range_errors import RangeErrors
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.traffic import Traffic
from jaxslam.simulation.trial_episodes import map_drives
from jaxslam.simulation.trial_noise import TrialNoise, draws_of, simulate_from_noise
from jaxslam.simulation.wheel_faults import WheelFaults
from jaxslam.study.runner import Variant
from jaxslam.study.sensitivities import Parameter
from jaxslam.study.trials_from_noise import Common, TrialsFromNoise, with_keys

MOUNT = "mount_x", "mount_y", "mount_yaw"
FILTER = (
    *("odometry_coefficients", "range_std", "bearing_std", "feature_std_scale"),
    "wall_angle_std",
)
LIFE: dict[str, Any] = {"ranges": RangeErrors, "traffic": Traffic, "wheels": WheelFaults}
NAMES = (
    *("encoder_noise", "range_noise", "scan_period"),
    *MOUNT,
    *(f"filter.{name}" for name in FILTER),
    "life.PART.FIELD",
)
"""Known parameters: the noise of the encoders and of the ranges; the period of the scans, which is
only made longer, by scans that are left out of the same drive; the pose of the scanner on the
robot, that its user does not know; the noise that the filter assumes; any number of `Life`, such as
`life.ranges.missing`."""


class TrialErrors:
    """Errors of the same N trials of a variant, with parameters changed.

    ```
    errors = TrialErrors(variant, ["encoder_noise", "range_noise"], num_trials=256, seed=0)
    found = sensitivities(errors.parameters, errors.log_errors, errors.gradients, max_error=1.0)
    ```
    """

    def __init__(self, variant: Variant, names: Sequence[str], *, num_trials: int, seed: int):
        """Draw the noise of the trials.

        Args:
            variant: What is driven.
            names: Of the parameters, some of `NAMES`.
            num_trials: N.
            seed: Of the noise.

        Raises:
            ValueError: A name is not known, no factor changes the parameter because it is 0, or
                scans are matched, of which no change is followed.
        """
        if variant.match_scans:
            raise ValueError("variant.match_scans is True; sensitivities are known without")
        self.parameters = tuple(parameter_of(variant, name) for name in names)
        self._names = tuple(names)
        self._trials = TrialsFromNoise(variant)
        self._noise = self._trials.plain_noise(seed, np.arange(num_trials))

    def log_errors(self, changes: np.ndarray) -> np.ndarray:
        """Logarithms (N,) of the position RMSE [m] with changes (P,); NaN where not finite."""
        return self._run(_ERRORS, changes)

    def gradients(self, changes: np.ndarray) -> np.ndarray:
        """Derivatives (N, P) of `log_errors` at the changes (P,), which are zero.

        Raises:
            ValueError: The changes are not zero.
        """
        if np.any(changes):
            raise ValueError("changes are not zero: there gradients are not known")
        return self._run(_GRADIENTS, changes)

    def _run(self, spread: DeviceMap, changes: np.ndarray) -> np.ndarray:
        shift = jnp.asarray(changes, float)
        return self._trials.spread(spread, self._noise, self._names, shift)


def parameter_of(variant: Variant, name: str) -> Parameter:
    """The parameter of a variant with a name of `NAMES`; ValueError as of `TrialErrors`."""
    robot, lidar = variant.robot, variant.config.frontend.lidar
    if name in MOUNT:
        place = MOUNT.index(name)
        unit, step = ("rad", 0.005) if name == "mount_yaw" else ("m", 0.005)
        return Parameter(name, robot.mount[place], unit, False, step, True)
    kind, _, rest = name.partition(".")
    if name == "encoder_noise":
        found = Parameter(name, robot.encoder_noise, "m / sqrt(m)", has_gradient=True)
    elif name == "range_noise":
        found = Parameter(name, lidar.range_std, "m")
        if robot.scanner is not None:
            found = Parameter(name, 1.0, "that of the scanner")
    elif name == "scan_period":
        step = math.log(2.0) / 2
        found = Parameter(name, robot.scan_period, "s", step=step, one_sided=True)
    elif kind == "filter" and rest in FILTER:
        value = float(np.max(np.asarray(getattr(variant.params, rest))))
        found = Parameter(name, value, "as of NoiseParams", has_gradient=True)
    elif kind == "life" and variant.life is not None and _is_of_life(rest):
        part, field = rest.split(".")
        value = float(getattr(getattr(variant.life, part), field))
        found = Parameter(name, value, "as of Life", step=0.1)
    else:
        known = ", ".join(NAMES)
        raise ValueError(f"parameter {name!r} is not known: there are {known}, if there is life")
    if not found.value > 0.0:
        raise ValueError(f"{name} is {found.value}: no factor changes it")
    return found


def _is_of_life(name: str) -> bool:
    """Whether a name is PART.FIELD of a number of `Life`."""
    part, _, field = name.partition(".")
    return part in LIFE and field in LIFE[part]._fields


class _Changed(NamedTuple):
    """What changed parameters make of a trial; the period of scans is that of how many times."""

    noise: TrialNoise
    params: NoiseParams
    life: Life | None
    mount_error: Array
    scan_period: Array


def _change(names: tuple[str, ...], changes: Array, common: Common, noise: TrialNoise) -> _Changed:
    """Noise and parameters of a trial with changes (P,)."""
    params, life = common.params, common.life
    mount, period = [jnp.zeros_like(changes[0])] * 3, jnp.ones_like(changes[0])
    for name, change in zip(names, changes, strict=True):
        kind, _, rest = name.partition(".")
        factor = jnp.exp(change)
        if name in MOUNT:
            mount[MOUNT.index(name)] = change
        elif name == "encoder_noise":
            noise = noise._replace(wheels=noise.wheels * factor)
        elif name == "range_noise":
            noise = noise._replace(ranges=noise.ranges * factor)
        elif name == "scan_period":
            period = factor
        elif kind == "filter":
            params = params._replace(**{rest: getattr(params, rest) * factor})
        elif life is not None:
            part, field = rest.split(".")
            own = getattr(life, part)
            changed = own._replace(**{field: getattr(own, field) * factor})
            life = life._replace(**{part: changed})
    return _Changed(noise, params, life, jnp.stack(mount), period)


def log_rmse(result: TrialResult) -> Array:
    """Logarithm () of the position RMSE [m] over the scans of a trial."""
    gap = (result.estimate - result.truth)[:, :2]
    return jnp.log(jnp.mean(jnp.sum(gap**2, axis=1))) / 2


def _errors(
    frontend: FrontendConfig,
    config: FilterConfig,
    robot: Robot,
    names: tuple[str, ...],
    key_type: Any,
    given: tuple[Common, Array],
    data: TrialNoise,
) -> Array:
    """Logarithms of the errors of the trials of a group."""
    common, changes = given

    def simulate(one: TrialNoise) -> Episode:
        own = _change(names, changes, common, with_keys(one, key_type))
        world = frontend, robot, common.world, common.path
        more: dict[str, Any] = {"life": own.life, "mount_error": own.mount_error}
        episode = simulate_from_noise(own.noise, *world, **more)
        kept = keeps(own.scan_period, len(one.scans))
        restrict = jax.vmap(lambda own, kept: restrict_features(own, kept & own.valid))
        return episode._replace(features=restrict(episode.features, kept))

    params = _change(names, changes, common, with_keys(_first(data), key_type)).params
    result = filter_batch(config, params, map_drives(simulate, data))
    return jnp.where(result.finite, jax.vmap(log_rmse)(result), jnp.nan)


def _gradients(
    frontend: FrontendConfig,
    config: FilterConfig,
    robot: Robot,
    names: tuple[str, ...],
    key_type: Any,
    given: tuple[Common, Array],
    data: TrialNoise,
) -> Array:
    """Derivatives (B, P) of the errors of the trials of a group."""
    common, changes = given

    def simulate(one: TrialNoise) -> Episode:
        world = frontend, robot, common.world, common.path
        return simulate_from_noise(with_keys(one, key_type), *world, life=common.life)

    def error(changes: Array, one: TrialNoise, episode: Episode) -> Array:
        own = _change(names, changes, common, with_keys(one, key_type))
        _, items, odometry = drives.drive_and_scan(
            draws_of(own.noise, own.life),
            frontend.lidar,
            robot,
            common.world,
            common.path,
            life=own.life,
            mount_error=own.mount_error,
        )
        truth = items[0]
        features = jax.vmap(features_from_pose)(truth, episode.truth, episode.features)
        moved = episode._replace(truth=truth, odometry=odometry, features=features)
        result = filter_episode(config, own.params, moved)
        return jnp.where(result.finite, log_rmse(result), jnp.nan)

    one_gradient = partial(jax.grad(error), changes)
    return jax.vmap(one_gradient)(data, map_drives(simulate, data))


def keeps(period: Array, num_scans: int) -> Array:
    """Which of T scans (T,) bool are made if their period is 1 or more times as long."""
    passed = jnp.arange(-1, num_scans, dtype=period.dtype) / period
    return jnp.diff(jnp.floor(passed + 1e-4)) > 0.0


def features_from_pose(pose: Array, seen_at: Array, features: Features) -> Features:
    """Features of a scan as from another pose, with the same errors in the frame of the world.

    Args:
        pose: (3,) [m, m, rad] from where they are to be seen.
        seen_at: (3,) from where they were.
        features: In the frame there.
    """
    step = relative(pose, seen_at)
    turn = rotation(step[2])
    point = features.valid & (features.kind != WALL)
    xy = features.xy @ turn.T + step[None, :2]
    cov = turn[None] @ features.cov @ turn.T[None]
    turned = features.direction + step[2]
    direction = jnp.where(features.kind == WALL, wrap_direction(turned), wrap_angle(turned))
    has_direction = features.valid & (features.direction != 0.0)
    return features._replace(
        xy=jnp.where(point[:, None], xy, features.xy),
        cov=jnp.where(point[:, None, None], cov, features.cov),
        direction=jnp.where(has_direction, direction, features.direction),
    )


def _first(data: TrialNoise) -> TrialNoise:
    return jax.tree.map(lambda x: x[0], data)


_ERRORS = DeviceMap(_errors, size=1, static=5, compile_quickly=True)
_GRADIENTS = DeviceMap(_gradients, size=1, static=5, compile_quickly=True)
