"""Arrowhead normal equations of batch SLAM: a chain of poses, and the landmarks they observe.

The unknowns are the steps dx_1 .. dx_T of the poses, 3 numbers each, and l_1 .. l_L of the
landmarks, 2 numbers each. The matrix of the normal equations is block tridiagonal in the poses,
block diagonal in the landmarks, and has a block between a pose and each landmark seen from it:

              dx_1 dx_2 dx_3 dx_4 ... dx_T |  l_1  l_2  l_3 ...  l_L
            +------------------------------+------------------------+
       dx_1 |  #    #                      |   #    #               |
       dx_2 |  #    #    #                 |   #    #               |
       dx_3 |       #    #    #            |        #    #          |
       dx_4 |            #    #    #       |             #          |
        :   |                 #    #    #  |                        |
       dx_T |                      #    #  |                     #  |
            +------------------------------+------------------------+
        l_1 |  #    #                      |   #                    |
        l_2 |  #    #    #                 |        #               |
        l_3 |            #    #            |             #          |
         :  |                              |                  #     |
        l_L |                           #  |                     #  |
            +------------------------------+------------------------+

The poses are eliminated one by one by a Kalman filter that is conditioned on the landmarks' step;
the system that remains, the Schur complement, is dense in the landmarks. The filter carries
covariances, not inverse covariances: next to very precise odometry the latter would lose all other
information to rounding in single precision.

References:
    Triggs et al. (1999), Bundle adjustment: a modern synthesis, section 6. Rauch, Tung, Striebel
    (1965), Maximum likelihood estimates of linear dynamic systems.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.linalg import whiten
from jaxslam.core.types import Array

State = tuple[Array, Array]
"""Poses (T, 3) and positions of landmarks (L, 2), or a step or a gradient of both."""


class Jacobian(NamedTuple):
    """Jacobian J of the whitened residuals, block by block.

    A step (dx, l) changes the residual of the odometry increment to pose t by
    W (dx_t - F dx_t-1), and that of feature m of scan t by `J_pose` dx_t + `J_landmark` l_index.

    Attributes:
        odometry_root: (T, 3, 3) W, square root of the information of the odometry increment.
        transition: (T, 3, 3) F. The first is not used, as the pose before it is known.
        odometry_cov: (T, 3, 3) covariance of the odometry increment, (W^T W)^-1.
        J_pose: (T, M, 2, 3) derivative of the features' residuals with respect to the pose; zero
            where masked.
        J_landmark: (T, M, 2, 2) derivative with respect to the landmark; zero where masked.
        landmark_index: (T, M) int32 landmark of each feature; any index where masked.
    """

    odometry_root: Array
    transition: Array
    odometry_cov: Array
    J_pose: Array
    J_landmark: Array
    landmark_index: Array


class _PoseTerms(NamedTuple):
    """Terms of the cost of a step that hold a pose: odometry and features, see `_eliminate`.

    Attributes:
        transition: (T, 3, 3) F.
        odometry_cov: (T, 3, 3) Q.
        curvature: (T, 3, 3) K.
        coupling: (T, 3, 2 L + 1) C.
    """

    transition: Array
    odometry_cov: Array
    curvature: Array
    coupling: Array


class _Filtered(NamedTuple):
    """What the forward pass keeps of each pose, see `_eliminate`.

    Attributes:
        predicted: (T, 3, 2 L + 1) B, mean before the features of the pose.
        updated: (T, 3, 2 L + 1) B', mean with them.
        slope: (T, 3, 2 L + 1) D, gradient of the features' terms at the predicted mean.
        gain: (T, 3, 3) G, smoother gain that takes a correction to the pose before.
    """

    predicted: Array
    updated: Array
    slope: Array
    gain: Array


def matvec(matrix: Array, vector: Array) -> Array:
    """Products (..., k) of matrices (..., k, n) and vectors (..., n)."""
    return jnp.sum(matrix * vector[..., None, :], axis=-1)


def apply_jacobian(jacobian: Jacobian, step: State) -> State:
    """Change J step of the residuals of odometry (T, 3) and of features (T, M, 2)."""
    poses, landmarks = step
    before = jnp.pad(poses[:-1], ((1, 0), (0, 0)))
    odometry = matvec(jacobian.odometry_root, poses - matvec(jacobian.transition, before))
    by_landmark = matvec(jacobian.J_landmark, landmarks[jacobian.landmark_index])
    return odometry, matvec(jacobian.J_pose, poses[:, None]) + by_landmark


def apply_transpose(jacobian: Jacobian, residuals: State, *, num_landmarks: int) -> State:
    """The transpose of `apply_jacobian`: J^T residuals, (T, 3) and (L, 2).

    Args:
        jacobian: J.
        residuals: Of odometry (T, 3) and of features (T, M, 2).
        num_landmarks: L.
    """
    like = jnp.zeros_like(residuals[0]), jnp.zeros((num_landmarks, 2), residuals[0].dtype)
    return jax.linear_transpose(partial(apply_jacobian, jacobian), like)(residuals)[0]


def landmark_blocks(jacobian: Jacobian, *, num_landmarks: int) -> Array:
    """Landmarks' diagonal blocks (L, 2, 2) of J^T J: their information if the poses were known.

    Args:
        jacobian: J.
        num_landmarks: L.
    """
    per_feature = jacobian.J_landmark.swapaxes(-1, -2) @ jacobian.J_landmark
    blocks = jnp.zeros((num_landmarks, 2, 2), per_feature.dtype)
    return blocks.at[jacobian.landmark_index].add(per_feature)


def solve_arrowhead(jacobian: Jacobian, prior_information: Array, right: State) -> State:
    """Solve (J^T J + prior) x = right.

    The derivative is that of the solution, by another solve, not of the elimination.

    Args:
        jacobian: J.
        prior_information: (L, 2, 2) symmetric, of the landmarks.
        right: (T, 3) and (L, 2).

    Returns:
        x like `right`; NaN where the matrix is not positive definite.
    """
    size = prior_information.shape[0]

    def product(step: State) -> State:
        change = apply_jacobian(jacobian, step)
        poses, landmarks = apply_transpose(jacobian, change, num_landmarks=size)
        return poses, landmarks + matvec(prior_information, step[1])

    def solution(_: object, right: State) -> State:
        blocks = landmark_blocks(jacobian, num_landmarks=size)
        return _eliminate(jacobian, blocks + prior_information, right)

    return lax.custom_linear_solve(product, right, solution, symmetric=True)


def _eliminate(jacobian: Jacobian, diagonal: Array, right: State) -> State:
    """Solve as `solve_arrowhead` does, by a filter over the poses conditioned on the landmarks.

    The solution minimises a sum of quadratic terms. With v = (l, 1), all landmarks' steps and a
    one, so that what is linear is a column of what is bilinear, the terms that hold pose t are

        |dx_t - F dx_t-1|^2_Q / 2  +  dx_t^T K dx_t / 2  +  dx_t^T C v,      dx_0 = 0

    of its odometry increment, and of its features and the right side r_t: K = sum H_x^T H_x and
    C = [sum H_x^T H_l, -r_t], for derivatives H_x = `J_pose` and H_l = `J_landmark`.

    Read exp(-cost) as a density, for any fixed v. Then these are the motion model and the
    measurements of a linear filter, whose means depend linearly on v: they are matrices times v.

        1. Forward, for t = 1 .. T, from B' = 0 and P' = 0:
               predict    B = F B'           P = F P' F^T + Q        G = P'_before F^T P^-1
               update     D = K B + C        P' = (P^-1 + K)^-1      B' = B - P' D
        2. Landmarks. The minimum over dx_t of all that holds dx_t is v^T (C^T B + D^T B') v / 2,
           besides the landmarks' own terms. Summed over t, this is the matrix

               S = [[S_ll, S_l1], [S_1l, S_11]],    and    (S_ll + diagonal) l = right_l - S_l1

        3. Backward, for t = T .. 1, with the l that was found (Rauch, Tung, Striebel):
               dx_t = B'_t v + G_t+1 (dx_t+1 - B_t+1 v)

    For the minimum in 2: setting the derivative of (dx - B v)^T P^-1 (dx - B v) / 2 and of the
    features' terms to zero gives dx = B v - P' D v; inserted, the value is
    v^T (B^T K B + B^T C + C^T B - D^T P' D) v / 2, where K B = D - C and P' D = B - B'.

    Args:
        jacobian: J.
        diagonal: (L, 2, 2) landmarks' blocks of the matrix, the prior's included.
        right: (T, 3) and (L, 2).
    """
    terms = _pose_terms(jacobian, diagonal.shape[0], right[0])
    filtered = _filter_poses(terms)
    landmarks = _solve_landmarks(terms, filtered, diagonal, right[1])
    return _smooth_poses(filtered, landmarks), landmarks.reshape(-1, 2)


def _pose_terms(jacobian: Jacobian, size: int, right: Array) -> _PoseTerms:
    """The terms of each pose, for `size` landmarks and the poses' right side (T, 3)."""
    steps = jacobian.landmark_index.shape[0]
    J_pose_T = jacobian.J_pose.swapaxes(-1, -2)
    coupling = jnp.zeros((steps, size, 3, 2), jacobian.J_landmark.dtype)
    coupling = coupling.at[jnp.arange(steps)[:, None], jacobian.landmark_index].add(
        J_pose_T @ jacobian.J_landmark
    )
    coupling = coupling.swapaxes(1, 2).reshape(steps, 3, 2 * size)
    coupling = jnp.concatenate([coupling, -right[..., None]], axis=2)
    curvature = jnp.sum(J_pose_T @ jacobian.J_pose, axis=1)
    return _PoseTerms(jacobian.transition, jacobian.odometry_cov, curvature, coupling)


def _filter_poses(terms: _PoseTerms) -> _Filtered:
    """Forward pass of `_eliminate`.

    With P = R^T R, the update is P' = R^T (I + R K R^T)^-1 R, which needs no inverse of P or K.
    """
    eye = jnp.eye(3, dtype=terms.curvature.dtype)
    inflation = 1 + 2 * jnp.finfo(eye.dtype).eps * eye  # so that P stays positive under rounding

    def forward(
        state: tuple[Array, Array], pose: _PoseTerms
    ) -> tuple[tuple[Array, Array], _Filtered]:
        cov_before, mean_before = state
        transition = pose.transition
        cov = (transition @ cov_before @ transition.T + pose.odometry_cov) * inflation
        predicted = transition @ mean_before
        # With P = L L^T: L^-1 P = L^T = R, and G = (L^-1 F P')^T L^-1.
        white = whiten(cov, jnp.concatenate([cov, transition @ cov_before, eye], axis=1))
        root, gain = white[:, :3], white[:, 3:6].T @ white[:, 6:]
        root = whiten(eye + root @ pose.curvature @ root.T, root)  # now of P' = root^T root
        slope = pose.curvature @ predicted + pose.coupling
        updated = predicted - root.T @ (root @ slope)
        return (root.T @ root, updated), _Filtered(predicted, updated, slope, gain)

    start = jnp.zeros_like(eye), jnp.zeros_like(terms.coupling[0])
    return lax.scan(forward, start, terms)[1]


def _solve_landmarks(
    terms: _PoseTerms, filtered: _Filtered, diagonal: Array, right: Array
) -> Array:
    """Step of the landmarks (2 L,): the dense system that is left once all poses are eliminated."""
    steps, size = len(terms.coupling), len(diagonal)

    def stack(first: Array, second: Array) -> Array:
        return jnp.concatenate([first, second], axis=1).reshape(6 * steps, -1)

    index = jnp.arange(size)
    own = jnp.zeros((size, 2, size, 2), diagonal.dtype).at[index, :, index].set(diagonal)
    # One product for sum_t C^T B + D^T B'; the mean with its transpose removes rounding.
    schur = stack(terms.coupling, filtered.slope).T @ stack(filtered.predicted, filtered.updated)
    schur = (schur + schur.T)[:-1] / 2  # [S_ll, S_l1]
    matrix = schur[:, :-1] + own.reshape(2 * size, -1)
    return _gauss_jordan(matrix, right.reshape(-1) - schur[:, -1])


def _smooth_poses(filtered: _Filtered, landmarks: Array) -> Array:
    """Backward pass of `_eliminate`: steps of the poses (T, 3), given that of landmarks (2 L,)."""
    v = jnp.append(landmarks, jnp.ones((), landmarks.dtype))

    def backward(correction: Array, pose: tuple[Array, ...]) -> tuple[Array, Array]:
        predicted, updated, gain = pose
        step = updated + correction
        return gain @ (step - predicted), step

    means = filtered.predicted @ v, filtered.updated @ v, filtered.gain
    return lax.scan(backward, jnp.zeros(3, v.dtype), means, reverse=True)[1]


def _gauss_jordan(matrix: Array, right: Array) -> Array:
    """Solution (n,) for a positive definite matrix (n, n) and right side (n,).

    Array operations only, no LAPACK, for the reason given in `core.linalg`; not unrolled, as n is
    large.
    """

    def eliminate_column(system: Array, k: Array) -> tuple[Array, None]:
        row = system[k] / jnp.where(system[k, k] > 0.0, system[k, k], jnp.nan)
        return (system - system[:, k, None] * row[None]).at[k].set(row), None

    system = jnp.concatenate([matrix, right[:, None]], axis=1)
    return lax.scan(eliminate_column, system, jnp.arange(right.size))[0][:, -1]
