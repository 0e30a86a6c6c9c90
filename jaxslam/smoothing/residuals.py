"""Residuals of the batch smoothing problem, whitened, and their Jacobian.

Whitened: multiplied by a root W of the information, W^T W = R^-1 for the covariance R, so that the
sum of their squares is the squared Mahalanobis norm.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.core.linalg import inverse_cholesky
from jaxslam.core.se2 import relative, rotation, wrap_angle, wrap_direction
from jaxslam.core.types import WALL, Array
from jaxslam.filtering import measurement_model
from jaxslam.smoothing.arrowhead import Jacobian, State, matvec
from jaxslam.smoothing.problem import LandmarkPrior, SmoothingProblem


class WhitenedProblem(NamedTuple):
    """A `SmoothingProblem` prepared for its evaluation at many states.

    Attributes:
        start: (3,) [m, m, rad] known pose before the first increment, map frame.
        odometry: (T, 3) [m, m, rad] odometry increments, in the frame of the pose before.
        odometry_cov: (T, 3, 3) their covariances in that frame, positive definite.
        measurement: (T, M, 2) as of `SmoothingProblem`; zero where masked.
        measurement_root: (T, M, 2, 2) W of each measurement; zero where masked.
        kind: (T, M) int32 `JUNCTION`, `CORNER` or `WALL`.
        landmark_index: (T, M) int32 landmark 0..L-1 of each feature; any where masked.
        prior: Of the landmarks; of no information where there is none.
    """

    start: Array
    odometry: Array
    odometry_cov: Array
    measurement: Array
    measurement_root: Array
    kind: Array
    landmark_index: Array
    prior: LandmarkPrior


def whitened(problem: SmoothingProblem, *, num_landmarks: int) -> WhitenedProblem:
    """Prepare a problem: roots of the information, and a prior if there is none.

    A feature is masked where it has no landmark, its numbers are not finite, or its covariance is
    none.

    Args:
        problem: The problem.
        num_landmarks: L.
    """
    measured, R, index = problem.measurement, problem.measurement_cov, problem.landmark_index
    usable = (index >= 0) & (index < num_landmarks) & jnp.all(jnp.isfinite(measured), axis=-1)
    usable &= (R[..., 0, 0] > 0.0) & (R[..., 0, 0] * R[..., 1, 1] > R[..., 0, 1] ** 2)
    usable &= jnp.all(jnp.isfinite(R), axis=(-2, -1))
    safe = jnp.where(usable[..., None, None], R, jnp.eye(2, dtype=R.dtype))
    no_prior = LandmarkPrior(
        jnp.zeros((num_landmarks, 2), R.dtype), jnp.zeros((num_landmarks, 2, 2), R.dtype)
    )
    return WhitenedProblem(
        start=problem.start,
        odometry=problem.odometry,
        odometry_cov=problem.odometry_cov,
        measurement=jnp.where(usable[..., None], measured, 0.0),
        measurement_root=jnp.where(usable[..., None, None], jax.vmap(jax.vmap(_root))(safe), 0.0),
        kind=problem.kind,
        landmark_index=jnp.where(usable, index, 0),
        prior=problem.prior or no_prior,
    )


def evaluate(problem: WhitenedProblem, state: State) -> tuple[Array, State, Jacobian, Array]:
    """Linearise the problem at a state.

    Args:
        problem: The problem.
        state: Poses (T, 3) and landmarks (L, 2).

    Returns:
        Squared Mahalanobis norm () of all residuals and of the prior's; whitened residuals of
        odometry (T, 3) and features (T, M, 2); their Jacobian; half the gradient (L, 2) of the
        prior's part.
    """
    residuals, jacobian = _residuals(problem, state)
    error = _wrap_walls(problem, state[1] - problem.prior.positions)
    pull = matvec(problem.prior.information, error)
    cost = sum(jnp.sum(x**2) for x in residuals) + jnp.sum(error * pull)
    return cost, residuals, jacobian, pull


def wrap_state(problem: WhitenedProblem, state: State) -> State:
    """The state with headings in [-pi, pi) and directions of observed walls in [-pi/2, pi/2).

    Args:
        problem: The problem.
        state: Poses (T, 3) and landmarks (L, 2).
    """
    poses, landmarks = state
    return poses.at[:, 2].set(wrap_angle(poses[:, 2])), _wrap_walls(problem, landmarks)


def _residuals(problem: WhitenedProblem, state: State) -> tuple[State, Jacobian]:
    """Whitened residuals of odometry (T, 3) and features (T, M, 2), and their Jacobian.

    For poses x_t = (p_t, heading) and increments u_t, with R_t the rotation by the heading and
    (x, y) = p_t - p_t-1, an error of the increment to pose t is, to first order,

        d(x_t-1^-1 x_t) = R_t-1^T (dx_t - F dx_t-1)    F = [1 0 -y; 0 1 x; 0 0 1]
    """
    poses, landmarks = state
    before = jnp.concatenate([problem.start[None], poses[:-1]])
    odometry = jax.vmap(relative)(before, poses) - problem.odometry
    odometry = odometry.at[:, 2].set(wrap_angle(odometry[:, 2]))
    x, y = (poses - before).T[:2]
    eye = jnp.zeros_like(problem.odometry_cov) + jnp.eye(3, dtype=x.dtype)[None]
    turn = eye.at[:, :2, :2].set(jax.vmap(rotation)(before[:, 2]))
    root = jax.vmap(_root)(problem.odometry_cov)
    predict = jax.vmap(jax.vmap(measurement_model.predict_measurement, in_axes=(None, 0, 0)))
    predicted, by_pose, by_landmark = predict(
        poses, landmarks[problem.landmark_index], problem.kind
    )
    feature = -measurement_model.residual(problem.measurement, predicted, problem.kind)
    jacobian = Jacobian(
        odometry_root=root @ turn.swapaxes(1, 2),
        transition=eye.at[:, :2, 2].set(jnp.stack([-y, x], axis=-1)),
        odometry_cov=turn @ problem.odometry_cov @ turn.swapaxes(1, 2),
        J_pose=problem.measurement_root @ by_pose,
        J_landmark=problem.measurement_root @ by_landmark,
        landmark_index=problem.landmark_index,
    )
    return (matvec(root, odometry), matvec(problem.measurement_root, feature)), jacobian


def _wrap_walls(problem: WhitenedProblem, landmarks: Array) -> Array:
    """Landmarks (L, 2), or differences of them, with the directions of observed walls wrapped."""
    wall = jnp.any(problem.measurement_root != 0.0, axis=(-2, -1)) & (problem.kind == WALL)
    wall = jnp.zeros(landmarks.shape[0], bool).at[problem.landmark_index].max(wall)
    return landmarks.at[:, 0].set(jnp.where(wall, wrap_direction(landmarks[:, 0]), landmarks[:, 0]))


def _root(cov: Array) -> Array:
    """W (k, k) with W^T W = cov^-1."""
    return inverse_cholesky(cov)[0]
