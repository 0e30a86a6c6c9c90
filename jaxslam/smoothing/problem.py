"""The batch smoothing problem: measurements with covariances, residuals and their Jacobian."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.core.features import restrict_features
from jaxslam.core.linalg import inverse_cholesky
from jaxslam.core.measurement import Measurement
from jaxslam.core.se2 import relative, rotation, wrap_angle, wrap_direction
from jaxslam.core.types import WALL, Array, check_array
from jaxslam.filtering import measurement_model
from jaxslam.filtering.noise import NoiseParams, measurement_cov, motion_estimate
from jaxslam.smoothing.arrowhead import Jacobian, State, matvec

ODOMETRY_STD_FLOOR = (
    1e-4  # [m], [rad] std added to each odometry increment: that of a robot at rest is zero
)


class LandmarkPrior(NamedTuple):
    """Prior of the landmarks.

    Attributes:
        positions: (L, 2) mean, as in `SmoothingResult`.
        information: (L, 2, 2) inverse covariance; zero where nothing is known.
    """

    positions: Array
    information: Array


class SmoothingProblem(NamedTuple):
    """The batch problem of one robot: odometry, landmark measurements, and their covariances.

    Attributes:
        start: (3,) known pose before the first increment, world frame.
        odometry: (T, 3) odometry increments, in the frame of the pose before.
        odometry_cov: (T, 3, 3) their covariances in that frame, positive definite.
        measurement: (T, M, 2) measured range [m] and bearing [rad], or direction [rad] of a wall and 0;
            robot frame.
        measurement_cov: (T, M, 2, 2) their covariances.
        kind: (T, M) int32 NODE, CORNER or WALL.
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
    """Smoothed trajectory and landmarks.

    Attributes:
        poses: (T, 3) world frame.
        landmark_positions: (L, 2) [m] world frame, or direction [rad] of a wall and 0.
        cost: (iterations + 1,) squared Mahalanobis norm of all residuals, the guess's first.
    """

    poses: Array
    landmark_positions: Array
    cost: Array


def build_problem(
    params: NoiseParams,
    start: Array,
    measurements: Measurement,
    landmark_index: Array,
    *,
    prior: LandmarkPrior | None = None,
    untrusted_inflation: float = 1.0,
) -> SmoothingProblem:
    """The batch problem of a filter's measurements.

    Args:
        params: Noise parameters; `ODOMETRY_STD_FLOOR` is added to the odometry's.
        start: (3,) known pose before the first increment, world frame.
        measurements: [T] of the filter; `known` is not used.
        landmark_index: (T, M) int32 landmark 0..L-1 of each feature; L, or -1, for none.
        prior: Of the landmarks.
        untrusted_inflation: Factor on the standard deviation of untrusted features, as `Config.filter.untrusted_inflation`.

    Raises:
        ValueError: `landmark_index` has another shape or type than the features; while tracing.
    """
    check_array("which", landmark_index, measurements.features.kind.shape, jnp.int32)
    features = jax.vmap(restrict_features)(measurements.features, landmark_index >= 0)
    motion, q = jax.vmap(motion_estimate, in_axes=(None, 0))(params, measurements)
    return SmoothingProblem(
        start=start,
        odometry=motion,
        odometry_cov=q + (ODOMETRY_STD_FLOOR**2 * jnp.eye(3, dtype=q.dtype))[None],
        measurement=jax.vmap(measurement_model.measure)(features),
        measurement_cov=jax.vmap(
            partial(measurement_cov, params, untrusted_inflation=untrusted_inflation)
        )(features),
        kind=features.kind,
        landmark_index=jnp.where(features.valid, landmark_index, -1),
        prior=prior,
    )


def check_problem(problem: SmoothingProblem, poses: Array, landmark_positions: Array) -> None:
    """Raise ValueError if shapes or types do not fit.

    Args:
        problem: The problem.
        poses: (T, 3).
        landmark_positions: (L, 2).

    Raises:
        ValueError: An array has another shape or type; the message names it.
    """
    check_array("poses", poses, ("T", 3), jnp.floating)
    check_array("places", landmark_positions, ("L", 2), jnp.floating)
    check_array("records.which", problem.landmark_index, (len(poses), "M"), jnp.int32)
    steps, scan, size = poses.shape[:1], problem.landmark_index.shape, landmark_positions.shape[:1]
    sizes = dict(start=(3,), motion=steps + (3,), q=steps + (3, 3), seen=scan + (2,))
    for name, shape in sizes.items():
        check_array(f"records.{name}", getattr(problem, name), shape, jnp.floating)
    check_array("records.r", problem.measurement_cov, scan + (2, 2), jnp.floating)
    check_array("records.kind", problem.kind, scan, jnp.int32)
    if problem.prior is not None:
        check_array("records.prior.places", problem.prior.positions, size + (2,), jnp.floating)
        check_array(
            "records.prior.information", problem.prior.information, size + (2, 2), jnp.floating
        )


def _root(cov: Array) -> Array:
    """W (k, k) with W^T W = cov^-1."""
    return inverse_cholesky(cov)[0]


def whitened(problem: SmoothingProblem, size: int) -> SmoothingProblem:
    """The problem with a prior, and with a root W of the information, W^T W = r^-1, instead of `r`.

    W is zero, which masks the feature, where it has no landmark or its numbers are not finite or
    not a covariance.

    Args:
        problem: The problem.
        size: Number L of landmarks.
    """
    seen, r, which = problem.measurement, problem.measurement_cov, problem.landmark_index
    usable = (which >= 0) & (which < size) & jnp.all(jnp.isfinite(seen), axis=-1)
    usable &= (r[..., 0, 0] > 0.0) & (r[..., 0, 0] * r[..., 1, 1] > r[..., 0, 1] ** 2)
    usable &= jnp.all(jnp.isfinite(r), axis=(-2, -1))
    safe = jnp.where(usable[..., None, None], r, jnp.eye(2, dtype=r.dtype))
    no_prior = LandmarkPrior(jnp.zeros((size, 2), r.dtype), jnp.zeros((size, 2, 2), r.dtype))
    return problem._replace(
        measurement=jnp.where(usable[..., None], seen, 0.0),
        measurement_cov=jnp.where(usable[..., None, None], jax.vmap(jax.vmap(_root))(safe), 0.0),
        landmark_index=jnp.where(usable, which, 0),
        prior=problem.prior or no_prior,
    )


def _residuals(records: SmoothingProblem, state: State) -> tuple[State, Jacobian]:
    """Whitened residuals of motions (T, 3) and features (T, M, 2), and their Jacobian.

    For poses x_t = (p_t, heading) and increments u_t, with R_t the rotation by the heading and
    (x, y) = p_t - p_t-1, an error of the motion to pose t is, to first order,

        d(x_t-1^-1 x_t) = R_t-1^T (dx_t - F dx_t-1)    F = [1 0 -y; 0 1 x; 0 0 1]
    """
    poses, landmarks = state
    before = jnp.concatenate([records.start[None], poses[:-1]])
    motion = jax.vmap(relative)(before, poses) - records.odometry
    motion = motion.at[:, 2].set(wrap_angle(motion[:, 2]))
    x, y = (poses - before).T[:2]
    eye = jnp.zeros_like(records.odometry_cov) + jnp.eye(3, dtype=x.dtype)[None]
    turn = eye.at[:, :2, :2].set(jax.vmap(rotation)(before[:, 2]))
    root = jax.vmap(_root)(records.odometry_cov)
    predict = jax.vmap(jax.vmap(measurement_model.predict_measurement, in_axes=(None, 0, 0)))
    predicted, by_pose, by_landmark = predict(
        poses, landmarks[records.landmark_index], records.kind
    )
    feature = -measurement_model.residual(records.measurement, predicted, records.kind)
    rows = Jacobian(
        odometry_root=root @ turn.swapaxes(1, 2),
        transition=eye.at[:, :2, 2].set(jnp.stack([-y, x], axis=-1)),
        odometry_cov=turn @ records.odometry_cov @ turn.swapaxes(1, 2),
        J_pose=records.measurement_cov @ by_pose,
        J_landmark=records.measurement_cov @ by_landmark,
        landmark_index=records.landmark_index,
    )
    return (matvec(root, motion), matvec(records.measurement_cov, feature)), rows


def _wrap_walls(records: SmoothingProblem, landmarks: Array) -> Array:
    """Landmarks (L, 2), or differences of them, with the directions of observed walls wrapped."""
    wall = jnp.any(records.measurement_cov != 0.0, axis=(-2, -1)) & (records.kind == WALL)
    wall = jnp.zeros(landmarks.shape[0], bool).at[records.landmark_index].max(wall)
    return landmarks.at[:, 0].set(jnp.where(wall, wrap_direction(landmarks[:, 0]), landmarks[:, 0]))


def wrap_state(problem: SmoothingProblem, state: State) -> State:
    """The state with headings in [-pi, pi) and directions of observed walls in [-pi/2, pi/2).

    Args:
        problem: As `whitened` returns them.
        state: Poses (T, 3) and landmarks (L, 2).
    """
    poses, landmarks = state
    return poses.at[:, 2].set(wrap_angle(poses[:, 2])), _wrap_walls(problem, landmarks)


def evaluate(problem: SmoothingProblem, state: State) -> tuple[Array, State, Jacobian, Array]:
    """Linearise the problem at a state.

    Args:
        problem: As `whitened` returns them.
        state: Poses (T, 3) and landmarks (L, 2).

    Returns:
        Squared Mahalanobis norm () of all residuals and of the prior's; whitened residuals of
        motions (T, 3) and features (T, M, 2); their Jacobian; half the gradient (L, 2) of the
        prior's part.
    """
    residuals, rows = _residuals(problem, state)
    error = _wrap_walls(problem, state[1] - problem.prior.positions)
    pull = matvec(problem.prior.information, error)
    return sum(jnp.sum(x**2) for x in residuals) + jnp.sum(error * pull), residuals, rows, pull
