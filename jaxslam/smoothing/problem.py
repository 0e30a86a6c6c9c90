"""The batch smoothing problem of one robot: the records, made of a filter's measurements.

The unknowns are all poses and the positions of all landmarks; both smoothers, `dense` and `sparse`,
minimise the squared Mahalanobis norm of the residuals of this problem (`residuals`).
"""

from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.arguments import as_array, as_float
from jaxslam.core.features import restrict_features
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import AnyArray, Array, check_array
from jaxslam.filtering import measurement_model
from jaxslam.filtering.inputs import as_features, as_scan_match, check_params
from jaxslam.filtering.noise import NoiseParams, measurement_cov, motion_estimate
from jaxslam.filtering.noise_model import NoiseModel

ODOMETRY_STD_FLOOR = 1e-4
"""[m], [rad] std added to each odometry increment: that of a robot at rest is zero."""


class LandmarkPrior(NamedTuple):
    """Prior of the landmarks.

    Attributes:
        positions: (L, 2) mean, as `SmoothingResult.landmark_positions`.
        information: (L, 2, 2) inverse covariance; zero where nothing is known.
    """

    positions: Array
    information: Array


class SmoothingProblem(NamedTuple):
    """The batch problem of one robot: odometry, landmark measurements, and their covariances.

    Attributes:
        start: (3,) [m, m, rad] known pose before the first increment, map frame.
        odometry: (T, 3) [m, m, rad] odometry increments, in the frame of the pose before.
        odometry_cov: (T, 3, 3) their covariances in that frame, positive definite.
        measurement: (T, M, 2) measured range [m] and bearing [rad], or direction [rad] of a wall
            and 0; robot frame.
        measurement_cov: (T, M, 2, 2) their covariances.
        kind: (T, M) int32 `JUNCTION`, `CORNER` or `WALL`.
        landmark_index: (T, M) int32 landmark 0..L-1 of each feature; L, or -1, for none.
        prior: Of the landmarks; None for none.
    """

    start: Array
    odometry: Array
    odometry_cov: Array
    measurement: Array
    measurement_cov: Array
    kind: Array
    landmark_index: Array
    prior: LandmarkPrior | None = None


class SmoothingResult(NamedTuple):
    """Smoothed trajectory and landmarks; JAX arrays of `smooth_trial`, NumPy of `smooth_log`.

    Attributes:
        poses: (T, 3) [m, m, rad] map frame.
        landmark_positions: (L, 2) [m] map frame, or direction [rad] of a wall and 0.
        cost: (iterations + 1,) squared Mahalanobis norm of all residuals, the guess's first.
    """

    poses: AnyArray
    landmark_positions: AnyArray
    cost: AnyArray


def build_problem(
    params: NoiseParams,
    start: AnyArray,
    measurements: Measurement,
    landmark_index: AnyArray,
    *,
    prior: LandmarkPrior | None = None,
    untrusted_inflation: float = 1.0,
    noise_model: NoiseModel | None = None,
) -> SmoothingProblem:
    """The batch problem of a filter's measurements.

    Args:
        params: Noise parameters; `ODOMETRY_STD_FLOOR` is added to the odometry's.
        start: (3,) [m, m, rad] known pose before the first increment, map frame.
        measurements: [T] of the filter; `landmark_ids` is not used.
        landmark_index: (T, M) int landmark 0..L-1 of each feature; L, or -1, for none, as of
            `number_landmarks`.
        prior: Of the landmarks.
        untrusted_inflation: Factor on the standard deviation of untrusted features, as
            `FilterConfig.untrusted_inflation`; static.
        noise_model: Functions that change Q and R, as `FilterConfig.noise_model`; static.

    Raises:
        ValueError: An argument has another shape or kind, or `untrusted_inflation` is not above
            0.
    """
    if not 0.0 < untrusted_inflation < np.inf:
        raise ValueError(
            f"untrusted_inflation is {untrusted_inflation}, not a finite number above 0"
        )
    start = as_float("start", start, (3,))
    measurements = _as_measurements(measurements)
    params = check_params(params, measurements.odometry.dtype)
    landmark_index = as_index("landmark_index", landmark_index, measurements.features.kind.shape)
    problem = _build_problem(
        params,
        start,
        measurements,
        landmark_index,
        untrusted_inflation=float(untrusted_inflation),
        noise_model=noise_model,
    )
    return problem._replace(prior=None if prior is None else _as_prior("prior", prior, "L"))


@partial(jax.jit, static_argnames=("untrusted_inflation", "noise_model"))
def _build_problem(
    params: NoiseParams,
    start: Array,
    measurements: Measurement,
    landmark_index: Array,
    *,
    untrusted_inflation: float,
    noise_model: NoiseModel | None,
) -> SmoothingProblem:
    """`build_problem` of what has been checked, without a prior."""
    features = jax.vmap(restrict_features)(measurements.features, landmark_index >= 0)
    of_odometry = partial(motion_estimate, noise_model=noise_model)
    odometry, odometry_cov = jax.vmap(of_odometry, in_axes=(None, 0))(params, measurements)
    floor = ODOMETRY_STD_FLOOR**2 * jnp.eye(3, dtype=odometry_cov.dtype)
    of_features = partial(
        measurement_cov, params, untrusted_inflation=untrusted_inflation, noise_model=noise_model
    )
    return SmoothingProblem(
        start=start,
        odometry=odometry,
        odometry_cov=odometry_cov + floor[None],
        measurement=jax.vmap(measurement_model.measure)(features),
        measurement_cov=jax.vmap(of_features)(features, measurements),
        kind=features.kind,
        landmark_index=jnp.where(features.valid, landmark_index, -1),
    )


def _as_prior(name: str, prior: LandmarkPrior, size: Any) -> LandmarkPrior:
    """A prior of `size` landmarks in JAX arrays, checked."""
    if not isinstance(prior, LandmarkPrior):
        raise ValueError(f"{name} is a {type(prior).__name__}, not a LandmarkPrior")
    positions = as_float(f"{name}.positions", prior.positions, (size, 2))
    information = as_float(f"{name}.information", prior.information, (len(positions), 2, 2))
    return LandmarkPrior(positions, information)


def _as_measurements(given: Measurement) -> Measurement:
    """Measurements [T] in JAX arrays of one precision, checked."""
    if not isinstance(given, Measurement):
        raise ValueError(f"measurements is a {type(given).__name__}, not a Measurement")
    odometry = as_float("measurements.odometry", given.odometry, ("T", 3))
    steps, dtype, matched = odometry.shape[:1], odometry.dtype, given.scan_match
    features = as_features("measurements.features", given.features, steps, dtype)
    if matched is not None:
        matched = as_scan_match("measurements.scan_match", matched, steps, dtype)
    return Measurement(odometry, features, scan_match=matched)


def as_index(name: str, x: Any, shape: tuple[Any, ...]) -> Array:
    """Indices or kinds as a JAX array of int32, checked.

    Args:
        name: Name of `x`, for the message.
        x: Whole numbers; JAX, NumPy or lists.
        shape: As of `check_array`.

    Raises:
        ValueError: They are of another shape, or no whole numbers.
    """
    x = as_array(name, x)
    check_array(name, x, shape, jnp.integer)
    return jnp.asarray(x, jnp.int32)


def as_problem(
    problem: SmoothingProblem, poses: AnyArray, landmark_positions: AnyArray
) -> tuple[SmoothingProblem, Array, Array]:
    """A problem and a guess in JAX arrays of one precision, the highest that is given; checked.

    Args:
        problem: The problem.
        poses: (T, 3) guess.
        landmark_positions: (L, 2) guess.

    Raises:
        ValueError: An array has another shape or kind; the message names it.
    """
    if not isinstance(problem, SmoothingProblem):
        raise ValueError(f"problem is a {type(problem).__name__}, not a SmoothingProblem")
    poses = as_float("poses", poses, ("T", 3))
    positions = as_float("landmark_positions", landmark_positions, ("L", 2))
    for name, x in (("poses", poses), ("landmark_positions", positions)):
        if len(x) == 0:
            raise ValueError(f"{name} is {x.dtype} {x.shape}: there is nothing to estimate")
    steps, size = len(poses), len(positions)
    index = as_index("problem.landmark_index", problem.landmark_index, (steps, "M"))
    scan, prior = index.shape, problem.prior
    if prior is not None:
        prior = _as_prior("problem.prior", prior, size)
    problem = SmoothingProblem(
        start=as_float("problem.start", problem.start, (3,)),
        odometry=as_float("problem.odometry", problem.odometry, (steps, 3)),
        odometry_cov=as_float("problem.odometry_cov", problem.odometry_cov, (steps, 3, 3)),
        measurement=as_float("problem.measurement", problem.measurement, (*scan, 2)),
        measurement_cov=as_float("problem.measurement_cov", problem.measurement_cov, (*scan, 2, 2)),
        kind=as_index("problem.kind", problem.kind, scan),
        landmark_index=index,
        prior=prior,
    )
    return _in_one_precision((problem, poses, positions))


def _in_one_precision(arrays: Any) -> Any:
    """The same arrays, the real ones in the highest precision that any of them has."""
    real = [x.dtype for x in jax.tree.leaves(arrays) if jnp.issubdtype(x.dtype, jnp.floating)]
    highest = reduce(np.promote_types, real)

    def convert(x: Array) -> Array:
        return x.astype(highest) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(convert, arrays)
