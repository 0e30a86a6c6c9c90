"""Mutual nearest neighbours in a gate, and the joint compatibility test of a scan's matches.

Both work on distances and covariances alone; nothing depends on the filter.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam.core.linalg import add_outer_products, inverse_cholesky
from jaxslam.core.types import Array


def match_nearest(distance: Array, possible: Array, *, gate: float, margin: float) -> Array:
    """Match features to landmarks one to one: gated mutual nearest neighbours.

    A pair is accepted when its distance is inside the gate, each is the nearest to the other, and
    the feature's second nearest landmark is further by the margin. A feature whose nearest landmark
    is ambiguous stays unmatched.

    Args:
        distance: (M, L) squared Mahalanobis distances.
        possible: (M, L) bool, pairs that may be matched at all.
        gate: Largest squared distance of a match.
        margin: How much further, in squared distance, the second nearest landmark must be.

    Returns:
        (M,) int32 landmark of each feature, L for none.
    """
    num_features, num_landmarks = distance.shape
    distance = jnp.where(possible & jnp.isfinite(distance), distance, jnp.inf)
    # The first of the nearest: two plain reductions are many times as fast as `argmin`.
    index = jnp.arange(num_landmarks, dtype=jnp.int32)[None]
    nearest = jnp.min(distance, axis=1)
    is_nearest = distance == nearest[:, None]
    best = jnp.min(jnp.where(is_nearest, index, num_landmarks - 1), axis=1)
    others = jnp.where(index == best[:, None], jnp.inf, distance)
    is_clear = jnp.min(others, axis=1) > nearest + margin
    is_mutual = jnp.argmin(distance[:, best], axis=0) == jnp.arange(num_features)
    accepted = (nearest < gate) & is_clear & is_mutual
    return jnp.where(accepted, best, num_landmarks).astype(jnp.int32)


def jointly_compatible(
    s: Array, residual: Array, rank: Array, *, probability: float = 0.999, rounds: int = 3
) -> Array:
    """Matches (M,) bool that remain when those that contradict the others are removed.

    The errors of the matches are correlated by the pose, so each may be inside its own gate while
    all together are not. The joint test:

        while  D^2 = v^T S^-1 v  >  chi-square quantile (probability, sum of rank):
            remove the match without which D^2 is smallest                 (at most `rounds` times)

    Removal without a new inversion: let W = S^-1 and u = W v. Split into match k (two rows) and
    the others, o. The inverse of a block of S is a Schur complement in W,

        S_oo^-1 = W_oo - W_ok W_kk^-1 W_ko

    and with W_ko v_o = u_k - W_kk v_k it follows that

        D^2 without k = D^2 - u_k^T W_kk^-1 u_k          u_o without k = u_o - W_ok W_kk^-1 u_k

    The match to remove is that of the largest u_k^T W_kk^-1 u_k. Both formulas, applied to whole
    matrices, also set the rows and columns of k to zero.

    Args:
        s: (2 M, 2 M) joint covariance S of the residuals; identity where there is no match.
        residual: (M, 2) innovations v; zero where there is no match.
        rank: (M,) int32 degrees of freedom of each residual: 2, 1, or 0 where there is no match.
        probability: That a correct set of matches passes the test.
        rounds: Largest number of matches that are removed.

    References:
        Neira, Tardos (2001), Data association in stochastic mapping using the joint
        compatibility test, with greedy removal in place of branch and bound.
    """
    from scipy.special import chdtri  # imported here, because it is slow to import

    degrees = np.maximum(np.arange(2 * rank.size + 1), 1)
    bound = jnp.asarray(chdtri(degrees, 1 - probability), s.dtype)
    root = inverse_cholesky(s)[0]
    inverse = add_outer_products(jnp.zeros_like(s), root, root)
    residual = residual.reshape(-1)
    weighted = jnp.sum(inverse * residual[None], axis=1)
    matches = _JointMatches(inverse, residual, weighted, rank)
    for _ in range(rounds):
        matches = _remove_worst(matches, bound)
    return matches.rank > 0


class _JointMatches(NamedTuple):
    """The matches that are left in `jointly_compatible`, N = 2 M.

    Attributes:
        inverse: (N, N) W, the inverse covariance of what is left.
        residual: (N,) v.
        weighted: (N,) u = W v.
        rank: (M,) int32 degrees of freedom; 0 for no match or a removed one.
    """

    inverse: Array
    residual: Array
    weighted: Array
    rank: Array


def _remove_worst(matches: _JointMatches, bound: Array) -> _JointMatches:
    """Remove the match that contributes most, if the joint distance is beyond its bound.

    Args:
        matches: What is left.
        bound: (2 M + 1,) largest joint squared distance by degrees of freedom.
    """
    inverse, residual, weighted, rank = matches
    count = rank.size
    index = jnp.arange(count, dtype=jnp.int32)
    # W_kk = [[a, b], [b, d]] and u_k = (x, y) of all matches k; W_kk^-1 u_k = (p, q).
    blocks = inverse.reshape(count, 2, count, 2)
    a, b, d = (blocks[index, i, index, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    x, y = weighted.reshape(count, 2).T
    determinant = jnp.maximum(a * d - b * b, 1e-30)
    p, q = (d * x - b * y) / determinant, (a * y - b * x) / determinant
    contribution = jnp.where(rank > 0, x * p + y * q, -jnp.inf)  # u_k^T W_kk^-1 u_k
    worst = jnp.argmax(contribution).astype(jnp.int32)
    remove = (jnp.sum(residual * weighted) > bound[jnp.sum(rank)]) & (rank[worst] > 0)

    columns = blocks[:, :, worst].reshape(-1, 2)  # W_:k
    solved = [  # columns of W_:k W_kk^-1
        (d[worst] * columns[:, 0] - b[worst] * columns[:, 1]) / determinant[worst],
        (a[worst] * columns[:, 1] - b[worst] * columns[:, 0]) / determinant[worst],
    ]
    schur = sum(solved[i][:, None] * columns[None, :, i] for i in range(2))
    without = weighted - columns[:, 0] * p[worst] - columns[:, 1] * q[worst]
    removed = remove & (index == worst)
    return _JointMatches(
        inverse=jnp.where(remove, inverse - schur, inverse),
        residual=jnp.where(jnp.repeat(removed, 2), 0.0, residual),
        weighted=jnp.where(remove, without, weighted),
        rank=jnp.where(removed, 0, rank),
    )
