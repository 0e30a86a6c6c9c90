"""Static configuration of the filter, and what follows from it: initial belief, confirmation."""

import math
from functools import lru_cache
from numbers import Integral, Real
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxslam.core.types import CORNER, JUNCTION, WALL, Array
from jaxslam.filtering.adaptation import AdaptationSpec, check_adaptation, initial_adaptation
from jaxslam.filtering.belief import Belief, initial_belief
from jaxslam.filtering.data_association import AssociationSpec
from jaxslam.filtering.ekf import check_linearisation
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.noise_model import NoiseModel
from jaxslam.filtering.odometry_bias import NUM_BIASES, initial_bias

KIND_NAMES = {JUNCTION: "JUNCTION", CORNER: "CORNER", WALL: "WALL"}
FULL_TURN = 2 * math.pi + 0.1  # [rad] widest field of view, with an allowance for rounding
# Least whole numbers of the configuration.
LEAST = {
    "max_landmarks": 1,
    "max_updates": 1,
    "max_new": 1,
    "confirm_count": 1,
    "wall_confirm_count": 1,
    "max_unconfirmed_age": 0,
    "evict_after": 0,
    "max_misses": 1,
}
# Thresholds of data association that may be 0; the others must be larger.
MAY_BE_ZERO = (
    "ambiguity_margin",
    "min_separation",
    "min_wall_angle",
    "support_distance",
    "verify_above_std",
)


class FilterConfig(NamedTuple):
    """Static configuration of the filter; hashable, static under jit.

    Attributes:
        landmark_kinds: Kinds of landmark that the filter uses.
        linearisation: `"standard"`, the paper's, or another of `ekf.LINEARISATIONS`.
        max_landmarks: L, capacity of the map.
        max_updates: Largest number of features that update the state in one scan.
        max_new: Largest number of new landmarks in one scan.
        association: Thresholds of data association.
        untrusted_inflation: Factor on the standard deviation of features that are not trusted.
        confirm_count: Number of observations (this one included) from which a landmark is
            confirmed. Only confirmed landmarks update the state.
        wall_confirm_count: Likewise for a wall direction: most scans show one, and a wrong one
            biases the heading.
        max_unconfirmed_age: Number of steps without an observation after which an unconfirmed
            landmark is pruned.
        evict_after: Number of steps without an observation after which an unconfirmed landmark
            may be evicted from a full map.
        max_misses: Number of consecutive missed detections after which a junction is pruned.
        field_of_view: [rad] directions of the scanner's first and last beam: outside, a detection
            cannot be missed. `Config.for_lidar` sets it.
        noise_model: Functions of one's own for Q and R, with `NoiseParams.custom`; None: none.
        odometry_bias_std: [-, -, rad / m] standard deviations of the biases of odometry at the
            start: distance per distance, rotation per rotation, rotation per distance; they are
            states then (`odometry_bias`). 0 fixes one; None: there are none.
        adaptation: How Q and R are scaled while the robot goes; None: they stay.
    """

    landmark_kinds: tuple[int, ...] = (JUNCTION, CORNER, WALL)
    linearisation: str = "standard"
    max_landmarks: int = 96
    max_updates: int = 8
    max_new: int = 8
    association: AssociationSpec = AssociationSpec()
    untrusted_inflation: float = 3.0
    confirm_count: int = 2
    wall_confirm_count: int = 4
    max_unconfirmed_age: int = 40
    evict_after: int = 5
    max_misses: int = 10
    field_of_view: tuple[float, float] = (-math.pi / 2, math.pi / 2)
    noise_model: NoiseModel | None = None
    odometry_bias_std: tuple[float, ...] | None = None
    adaptation: AdaptationSpec | None = None


def check_config(config: FilterConfig) -> None:
    """Check the configuration of the filter; what was checked once costs a look-up.

    Raises:
        ValueError: It is no `FilterConfig`, or one of its numbers or options is unknown or out of
            range; the message states which, and what is expected.
    """
    if not isinstance(config, FilterConfig):
        hint = "; pass config.filter" if hasattr(config, "filter") else ""
        raise ValueError(f"config is {type(config).__name__}, not FilterConfig{hint}")
    for name, value in config._asdict().items():
        try:
            hash(value)
        except TypeError:
            kind = type(value).__name__
            raise ValueError(f"config.{name} is {kind}, not hashable: give a tuple") from None
    if not isinstance(config.association, AssociationSpec):
        kind = type(config.association).__name__
        raise ValueError(f"config.association is {kind}, not AssociationSpec")
    _check_fields(config, tuple(map(type, config + config.association)))


@lru_cache(maxsize=256)
def _check_fields(config: FilterConfig, _: tuple[type, ...]) -> None:
    """Check a hashable configuration; by its types the cache keeps 96 and 96.0 apart."""
    check_linearisation(config.linearisation)
    kinds = config.landmark_kinds
    if not isinstance(kinds, tuple) or not kinds or not set(kinds) <= set(KIND_NAMES):
        known = ", ".join(f"{kind} ({name})" for kind, name in KIND_NAMES.items())
        raise ValueError(f"config.landmark_kinds is {kinds!r}, not a tuple of {known}")
    for name, least in LEAST.items():
        _check_number(name, getattr(config, name), least, whole=True)
    _check_number("untrusted_inflation", config.untrusted_inflation, 0, above=True)
    if not math.isfinite(config.untrusted_inflation):
        raise ValueError(f"config.untrusted_inflation is {config.untrusted_inflation}, not finite")
    for name, value in config.association._asdict().items():
        if name == "verify_scans":
            _check_number(f"association.{name}", value, 1, whole=True)
        else:
            _check_number(f"association.{name}", value, 0, above=name not in MAY_BE_ZERO)
    model = config.noise_model
    if model is not None:
        is_model = isinstance(model, NoiseModel)
        if not is_model or not all(x is None or callable(x) for x in model):
            raise ValueError(f"config.noise_model is {model!r}, not a NoiseModel of functions")
    std = config.odometry_bias_std
    if std is not None and not (
        isinstance(std, tuple)
        and len(std) == NUM_BIASES
        and all(isinstance(x, Real) and 0.0 <= x < math.inf for x in std)
    ):
        wanted = f"a tuple of {NUM_BIASES} finite standard deviations, 0 or more"
        raise ValueError(f"config.odometry_bias_std is {std!r}, not {wanted}")
    if config.adaptation is not None:
        check_adaptation("config.adaptation", config.adaptation)
    view = config.field_of_view
    numbers = isinstance(view, tuple) and len(view) == 2 and all(isinstance(x, Real) for x in view)
    if not numbers or not 0.0 < view[1] - view[0] <= FULL_TURN:
        wanted = "(first, last) beam [rad], increasing, one turn at most"
        raise ValueError(f"config.field_of_view is {view}, not {wanted}")


def _check_number(
    name: str, value: Any, least: int, *, whole: bool = False, above: bool = False
) -> None:
    """Raise ValueError unless a number of the configuration is at least, or above, a bound."""
    kind = Integral if whole else Real
    is_number = isinstance(value, kind) and not isinstance(value, bool)
    if not is_number or not (value > least if above else value >= least):  # NaN compares false
        wanted = (
            f"a {'whole ' if whole else ''}number {'above' if above else 'of at least'} {least}"
        )
        raise ValueError(f"config.{name} is {value!r}, not {wanted}")


def init(config: FilterConfig, pose: Array, cov: Array | None = None) -> Belief:
    """Initial belief of a robot with an empty map.

    Args:
        config: Static configuration of the filter.
        pose: (3,) [m, m, rad] first pose, map frame.
        cov: (3, 3) covariance of the pose; zero by default, as the map has no other origin.

    Raises:
        ValueError: The configuration is wrong (`check_config`), `pose` or `cov` has another shape
            or holds no numbers, or `cov` is not symmetric and positive semi-definite.
    """
    check_config(config)
    belief = initial_belief(pose, max_landmarks=config.max_landmarks, cov=cov)
    return with_options(config, belief)


def with_options(config: FilterConfig, belief: Belief) -> Belief:
    """The belief with biases of odometry and scales of the noise, where the configuration has them.

    Those that it has already stay. They begin anew where a belief, as of a saved map, has none.
    """
    size, dtype = belief.num_seen.size, belief.mean.dtype
    if config.odometry_bias_std is None:
        belief = belief._replace(bias=None)
    elif belief.bias is None:
        belief = belief._replace(bias=initial_bias(config.odometry_bias_std, size, dtype))
    if config.adaptation is None:
        belief = belief._replace(adaptation=None)
    elif belief.adaptation is None:
        belief = belief._replace(adaptation=initial_adaptation(dtype))
    return belief


def check_options(config: FilterConfig, params: NoiseParams, belief: Belief | None = None) -> None:
    """Check that parameters and belief have what the options of the configuration need.

    Args:
        config: Static configuration of the filter.
        params: Noise parameters.
        belief: Belief, if there is one already.

    Raises:
        ValueError: One has something that the configuration does not use, or lacks something.
    """
    if belief is not None:
        _check_belief(config, belief)
    if params.odometry_bias_walk is not None and config.odometry_bias_std is None:
        raise ValueError(
            "params.odometry_bias_walk is given, but config.odometry_bias_std is None: there are "
            "no biases"
        )
    if params.custom is not None and config.noise_model is None:
        raise ValueError(
            "params.custom is given, but config.noise_model is None: nothing would use it"
        )


def _check_belief(config: FilterConfig, belief: Belief) -> None:
    """Raise ValueError unless a belief has what the options of the configuration need, no more."""
    for option, field in (("odometry_bias_std", "bias"), ("adaptation", "adaptation")):
        wanted, given = getattr(config, option) is not None, getattr(belief, field) is not None
        if wanted != given:
            of_config, of_belief = ("is given", "is None") if wanted else ("is None", "is given")
            raise ValueError(
                f"config.{option} {of_config}, but belief.{field} {of_belief}; make the belief by "
                "init(config, pose), or with_options(config, belief)"
            )


def required_observations(config: FilterConfig, kind: Array) -> Array:
    """Number of observations (...) that confirm landmarks of these kinds (...) int32."""
    return jnp.where(kind == WALL, config.wall_confirm_count, config.confirm_count)


def confirmed(config: FilterConfig, belief: Belief) -> Array:
    """Landmarks (L,) bool with enough observations to update the state."""
    return belief.num_seen >= required_observations(config, belief.kind)
