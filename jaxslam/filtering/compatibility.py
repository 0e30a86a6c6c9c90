"""Mutual nearest neighbours in a gate, and the joint compatibility test of a scan's matches.

Both work on distances and covariances alone; nothing depends on the filter.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.linalg import inverse_cholesky
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


class JointMatches(NamedTuple):
    """The matches of a scan that are kept, and their joint covariance factored.

    Attributes:
        kept: (M,) bool.
        passed: (M,) bool, those that pass the joint test, before their review.
        factor: Of `inverse_cholesky`, of S with rows and columns of the identity where a match is
            not kept.
    """

    kept: Array
    passed: Array
    factor: tuple[Array, Array, Array]


def jointly_compatible(
    s: Array,
    residual: Array,
    rank: Array,
    *,
    review: Callable[[Array], Array] | None = None,
    probability: float = 0.999,
    rounds: int = 3,
) -> JointMatches:
    """The matches that remain when those that contradict the others are removed.

    The errors of the matches are correlated by the pose, so each may be inside its own gate while
    all together are not. The joint test:

        while  D^2 = v^T S^-1 v  >  chi-square quantile (probability, sum of rank):
            remove the match without which D^2 is smallest                 (at most `rounds` times)
        remove those that `review` does not keep

    The match to remove is found without further inversions: let W = S^-1 and u = W v. Split into
    match k (two rows) and the others, o. The inverse of a block of S is a Schur complement in W,

        S_oo^-1 = W_oo - W_ok W_kk^-1 W_ko

    and with W_ko v_o = u_k - W_kk v_k it follows that

        D^2 without k = D^2 - u_k^T W_kk^-1 u_k

    It is that of the largest u_k^T W_kk^-1 u_k. Most scans pass at once, so the
    loop turns once for most batches, and its factor of S is that of the Kalman update. Nothing
    here has a derivative.

    Args:
        s: (2 M, 2 M) joint covariance S of the residuals; identity where there is no match.
        residual: (M, 2) innovations v; zero where there is no match.
        rank: (M,) int32 degrees of freedom of each residual: 2, 1, or 0 where there is no match.
        review: Which of the matches (M,) bool that pass are kept, (M,) bool; by default all.
        probability: That a correct set of matches passes the test.
        rounds: Largest number of matches that are removed by the test.

    References:
        Neira, Tardos (2001), Data association in stochastic mapping using the joint
        compatibility test, with greedy removal in place of branch and bound.
    """
    from scipy.special import chdtri  # imported here, because it is slow to import

    s, residual = lax.stop_gradient((s, residual))
    degrees = np.maximum(np.arange(2 * rank.size + 1), 1)
    bound = jnp.asarray(chdtri(degrees, 1 - probability), s.dtype)

    def turn(state: _Round) -> _Round:
        kept = state.kept
        factor = inverse_cholesky(_masked(s, kept))
        v = jnp.where(kept[:, None], residual, 0.0).reshape(-1)
        white = jnp.sum(factor[0] * v[None], axis=1)
        fails = jnp.sum(white * white) > bound[jnp.sum(jnp.where(kept, rank, 0))]
        remove = fails & (state.num_removed < rounds) & ~state.is_reviewed
        passed = jnp.where(state.is_reviewed, state.factored.passed, kept)
        reviewed = kept if review is None else kept & review(kept)
        left = jnp.where(state.is_reviewed, kept, reviewed)
        left = jnp.where(remove, kept & ~_contributes_most(factor[0], white, kept), left)
        return _Round(
            kept=left,
            factored=JointMatches(kept, passed, factor),
            num_removed=state.num_removed + remove.astype(jnp.int32),
            is_reviewed=~remove,
            is_stale=jnp.any(left != kept),
        )

    matched, no = rank > 0, jnp.zeros((), bool)
    blank = JointMatches(matched, matched, (jnp.zeros_like(s), jnp.zeros((), s.dtype), no))
    start = _Round(matched, blank, jnp.int32(0), no, ~no)
    return lax.while_loop(lambda state: state.is_stale, turn, start).factored


class _Round(NamedTuple):
    """State of the loop of `jointly_compatible`.

    Attributes:
        kept: (M,) bool, matches that are left.
        factored: Those of the turn before, factored.
        num_removed: () int32 how many the joint test has removed.
        is_reviewed: () bool, the joint test is over.
        is_stale: () bool, `factored` is of others than are left.
    """

    kept: Array
    factored: JointMatches
    num_removed: Array
    is_reviewed: Array
    is_stale: Array


def _masked(s: Array, kept: Array) -> Array:
    """S with rows and columns of the identity where a match is not kept."""
    rows = jnp.repeat(kept, 2)
    return jnp.where(rows[:, None] & rows[None], s, jnp.eye(len(s), dtype=s.dtype))


def _contributes_most(root: Array, white: Array, kept: Array) -> Array:
    """The match (M,) bool, of those that are kept, without which D^2 is smallest.

    Args:
        root: (2 M, 2 M) A with A S A^T = I.
        white: (2 M,) A v.
        kept: (M,) bool.
    """
    # W_kk = [[a, b], [b, d]] and u_k = (x, y) of all matches k, from W = A^T A and u = A^T w.
    first, second = root[:, 0::2], root[:, 1::2]
    a, b, d = (jnp.sum(p * q, axis=0) for p, q in ((first, first), (first, second), (second,) * 2))
    x, y = (jnp.sum(p * white[:, None], axis=0) for p in (first, second))
    square = (d * x * x - 2 * b * x * y + a * y * y) / jnp.maximum(a * d - b * b, 1e-30)
    worst = jnp.argmax(jnp.where(kept, square, -jnp.inf))
    return kept & (jnp.arange(kept.size) == worst)
