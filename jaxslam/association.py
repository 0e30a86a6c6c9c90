"""Data association: gated nearest neighbour, joint compatibility, slots and numbers of landmarks.

All of it works on distances, covariances and ids; nothing depends on the filter.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.special import chdtri

from jaxslam.linalg import add_products, inverse_root
from jaxslam.nodes import Nodes
from jaxslam.poses import placed
from jaxslam.types import WALL, Array, expect


class Landmarks(NamedTuple):
    """Landmarks of a filtered log, numbered without gaps, padded to L.

    Attributes:
        which: (T, M) int32 landmark 0..L-1 of each feature, L for none.
        places: (L, 2) initial estimate, map frame: position [m] of a point, direction [rad] of a
            wall and 0; zero for padding.
        id: (L,) int32 id that the filter gave the landmark; -1 for padding.
    """

    which: Array
    places: Array
    id: Array


def match(distance: Array, possible: Array, *, gate: float, margin: float) -> Array:
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


def compatible(
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
    degrees = np.maximum(np.arange(2 * rank.size + 1), 1)
    bound = jnp.asarray(chdtri(degrees, 1 - probability), s.dtype)
    root = inverse_root(s)[0]
    inverse = add_products(jnp.zeros_like(s), root, root)
    residual = residual.reshape(-1)
    weighted = jnp.sum(inverse * residual[None], axis=1)
    matches = _JointMatches(inverse, residual, weighted, rank)
    for _ in range(rounds):
        matches = _remove_worst(matches, bound)
    return matches.rank > 0


class _JointMatches(NamedTuple):
    """The matches that are left in `compatible`, N = 2 M.

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


def claim_slots(worth: Array, wanted: Array) -> Array:
    """Assign slots to features, the cheapest slot to the first feature.

    Args:
        worth: (L,) eviction cost of each slot: 0 for a free one, infinite for one that must not be
            evicted.
        wanted: (M,) bool, features that need a slot.

    Returns:
        (M,) int32 slot of each feature; L, out of range, where it gets none.
    """
    num_slots = worth.size
    negative_cost, order = lax.top_k(-worth, min(num_slots, wanted.size))  # of equals the first
    turn = jnp.cumsum(wanted, dtype=jnp.int32) - 1  # of each feature in the queue
    rank = jnp.clip(turn, 0, order.size - 1)
    available = wanted & (turn < order.size) & (negative_cost[rank] > -jnp.inf)
    return jnp.where(available, order[rank], num_slots).astype(jnp.int32)


def landmarks(
    id: Array, poses: Array, nodes: Nodes, *, least: int = 2, size: int | None = None
) -> Landmarks:
    """Number the landmarks of a filtered log by their ids, which unlike slots are never reused.

    Computed on the host. The initial estimate is the mean of all observations.

    Args:
        id: (T, M) int32 the filter's landmark id of each feature, -1 for none.
        poses: (T, 3) [m, m, rad] estimated by the filter, map frame.
        nodes: [T] features that the filter was given, base_link frame.
        least: Smallest number of observations of a landmark; others are left out.
        size: L, to give several logs the same shape; by default the number of landmarks, at
            least 1.

    Raises:
        ValueError: The shapes do not fit, or there are more than `size` landmarks.
    """
    expect("id", id, nodes.kind.shape, jnp.int32)
    expect("poses", poses, nodes.kind.shape[:1] + (3,), jnp.floating)
    ids = np.asarray(id)
    kept_ids, count = np.unique(ids[ids >= 0], return_counts=True)
    kept_ids = kept_ids[count >= least]
    size = max(len(kept_ids), 1) if size is None else size
    if len(kept_ids) > size:
        raise ValueError(f"{len(kept_ids)} landmarks are more than size = {size}")
    which = np.where(np.isin(ids, kept_ids), np.searchsorted(kept_ids, ids), size)
    positions = _mean_positions(which, np.asarray(poses), nodes, size)
    padded = np.pad(kept_ids, (0, size - len(kept_ids)), constant_values=-1)
    return Landmarks(
        which=jnp.asarray(which, jnp.int32),
        places=jnp.asarray(positions),
        id=jnp.asarray(padded, jnp.int32),
    )


def _mean_positions(which: np.ndarray, poses: np.ndarray, nodes: Nodes, size: int) -> np.ndarray:
    """Mean (L, 2) of the observations of each landmark, map frame.

    Directions of walls are undirected lines: they are averaged as unit vectors at twice the angle.
    """
    kept = which < size
    kept_which, is_wall = which[kept], (np.asarray(nodes.kind) == WALL)[kept]
    angle = (np.asarray(nodes.direction) + poses[:, 2:])[kept]
    doubled = np.stack([np.cos(2 * angle), np.sin(2 * angle)], axis=-1)
    points = placed(poses[:, None], np.asarray(nodes.xy))[kept]
    total = np.zeros((size, 2), points.dtype)
    np.add.at(total, kept_which, np.where(is_wall[:, None], doubled, points))
    positions = total / np.maximum(np.bincount(kept_which, minlength=size), 1)[:, None]
    walls = kept_which[is_wall]
    positions[walls, 0] = np.arctan2(total[walls, 1], total[walls, 0]) / 2
    positions[walls, 1] = 0.0
    return positions.astype(total.dtype)
