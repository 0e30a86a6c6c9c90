"""Poses of a pose graph without a good guess: headings first, then positions, both linear.

Given the headings, the positions are a linear least-squares problem; and the headings alone are
one, as soon as it is known which multiple of 2 pi each difference has:

    minimise  sum_ij w_ij (theta_j - theta_i - z_ij)^2 / var_ij                  headings
    minimise  sum_ij w_ij |p_j - p_i - R(theta_i) z_ij|^2_cov_ij                 positions

So a loop that is metres open is closed where a nonlinear solver, which starts from the poses as
they are, would take the closure for an outlier. All factors have a kernel of Geman and
McClure whose scale shrinks, from the least-squares solution and about its largest residual on
(graduated non-convexity): if a few of them alone can explain the rest, as where wheels slipped
once, these are found.

References:
    Carlone, Aragues, Castellanos, Bona (2014), A fast and accurate approximation for planar pose
    graph optimization. Carlone, Tron, Daniilidis, Dellaert (2015), Initialization techniques for 3D
    SLAM. Yang, Antonante, Tzoumas, Carlone (2020), Graduated non-convexity for robust spatial
    perception.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from jaxslam.core.se2_np import relative, wrap_angle
from jaxslam.core.types import as_float64

SCALE = 3.0
"""[std] of the kernel at the end."""

SHRINK = 0.6
"""Factor on it from iteration to iteration."""

MAX_ITERATIONS = 30

MIN_WEIGHT = 1e-6
"""Of a factor that is wrong: what nothing else determines, it still does."""


class Factors(NamedTuple):
    """N relative poses with their covariances.

    Attributes:
        first: (N,) int index of a pose.
        second: (N,) int index of another.
        relative_pose: (N, 3) [m, m, rad] pose of the second in the frame of the first.
        cov: (N, 3, 3) covariance, in the same frame; between position and heading, it is not used.
    """

    first: np.ndarray
    second: np.ndarray
    relative_pose: np.ndarray
    cov: np.ndarray


class Solution(NamedTuple):
    """Poses (T, 3) [m, m, rad], the first as it was; and the weights (N, 2) of the factors.

    The weights are of the heading and of the position, from 0, wrong, to 1.
    """

    poses: np.ndarray
    weight: np.ndarray


def solve_rotation_first(poses: np.ndarray, factors: Factors) -> Solution:
    """Poses that fit robust factors; their guess matters only for multiples of 2 pi.

    Args:
        poses: (T, 3) [m, m, rad] guess; the difference of the headings of two poses that a factor
            joins is wrong by less than pi.
        factors: They join each pose to the first one.

    Raises:
        ValueError: Arrays do not fit or are not finite, or poses are not joined.
    """
    poses = as_float64("poses", poses, ("T", 3)).copy()
    factors = _as_factors(factors, len(poses))
    first, second = factors.first, factors.second
    if len(poses) == 1:
        return Solution(poses, np.ones((0, 2)))
    off = relative(poses[first], poses[second])[:, 2] - factors.relative_pose[:, 2]
    root = 1.0 / np.sqrt(factors.cov[:, 2, 2])[:, None, None]
    turned, heading_weight = _robust(
        len(poses), factors, root, -wrap_angle(off)[:, None], np.ones(len(first))
    )
    poses[:, 2] = poses[:, 2] + turned[:, 0]
    heading = poses[first, 2]
    cosine, sine = np.cos(heading), np.sin(heading)
    turn = np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)
    step = (turn @ factors.relative_pose[:, :2, None])[..., 0]
    root = np.linalg.cholesky(np.linalg.inv(factors.cov[:, :2, :2])).swapaxes(1, 2)
    root = root @ turn.swapaxes(1, 2)
    moved, weight = _robust(len(poses), factors, root, step, heading_weight)
    poses[:, :2] = poses[0, :2] + moved
    poses[:, 2] = wrap_angle(poses[:, 2])
    return Solution(poses, np.stack([heading_weight, weight], axis=1))


def _as_factors(factors: Factors, num_poses: int) -> Factors:
    """Factors in NumPy arrays, checked.

    Raises:
        ValueError: An array has another shape, or is not finite; a pose is joined to no other.
    """
    count = len(factors.first)
    checked = {
        name: as_float64(f"factors.{name}", getattr(factors, name), shape)
        for name, shape in (("relative_pose", (count, 3)), ("cov", (count, 3, 3)))
    }
    for name, array in checked.items():
        if not np.isfinite(array).all():
            raise ValueError(f"factors.{name} is not finite")
    ends = np.asarray(factors.first), np.asarray(factors.second)
    graph = sparse.coo_matrix((np.ones(count), ends), (num_poses, num_poses))
    parts, number = connected_components(graph, directed=False)
    if parts > 1:
        alone = int(np.flatnonzero(number != number[0])[0])
        raise ValueError(f"factors: pose {alone} is not joined to the first one")
    return Factors(*ends, **checked)


def _robust(
    num_poses: int, factors: Factors, root: np.ndarray, step: np.ndarray, prior_weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns (T, D), the first zero, of robust linear differences; and weights (N,).

    Args:
        num_poses: T.
        factors: N, of which the indices are used.
        root: (N, D, D) root of the information of each difference.
        step: (N, D) difference of the second and the first.
        prior_weight: (N,) factor on the weight.
    """
    count, size = step.shape
    rows = np.repeat(np.arange(count), 2)
    columns = np.stack([factors.first, factors.second], axis=1).ravel()
    ends = sparse.csr_matrix((np.tile([-1.0, 1.0], count), (rows, columns)), (count, num_poses))
    incidence = sparse.kron(ends, np.eye(size)).tocsr()[:, size:]
    whiten = sparse.block_diag(list(root), format="csr")
    matrix, goal = whiten @ incidence, (root @ step[..., None]).ravel()
    weight, scale = np.ones(count), np.inf
    for _ in range(MAX_ITERATIONS):
        every = np.repeat(weight * prior_weight, size)
        normal = (matrix.T @ sparse.diags(every) @ matrix).tocsc()
        found = splu(normal).solve(matrix.T @ (every * goal))
        square = np.sum((matrix @ found - goal).reshape(count, size) ** 2, axis=1)
        if scale == SCALE:
            break
        scale = max(SCALE, SHRINK * min(scale, np.sqrt(square.max(initial=0.0))))
        weight = np.maximum((scale**2 / (scale**2 + square)) ** 2, MIN_WEIGHT)
    return np.concatenate([np.zeros((1, size)), found.reshape(-1, size)]), weight
