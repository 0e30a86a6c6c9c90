"""Which feature is which landmark: gates on distances, and numbers over a run; knows no filter."""

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
    """Landmarks of a filtered run, numbered without gaps, padded to L."""

    which: Array  # (T, M) int32 landmark 0..L-1 of each feature, L for none
    places: Array  # (L, 2) first guess; zero for padding
    id: Array  # (L,) int32 of the filter; -1 for padding


def match(distance: Array, possible: Array, *, gate: float, margin: float) -> Array:
    """Match features to landmarks one to one.

    A pair is believed when it lies in the gate, each is the nearest to the other, and the
    runner-up of the feature is clearly further; what is ambiguous stays unmatched.

    Args:
        distance: (M, L) squared Mahalanobis distances.
        possible: (M, L) bool, pairs that may be matched at all.
        gate: Largest squared distance of a match.
        margin: How much further, in squared distance, the second nearest landmark must be.

    Returns:
        (M,) int32 landmark of each feature, L for none.
    """
    m, l = distance.shape
    d = jnp.where(possible & jnp.isfinite(distance), distance, jnp.inf)
    # The first of the least: two plain reductions are many times as fast as `argmin`.
    index = jnp.arange(l, dtype=jnp.int32)[None]
    nearest = jnp.min(d, axis=1)
    best = jnp.min(jnp.where(d == nearest[:, None], index, l - 1), axis=1)
    others = jnp.where(index == best[:, None], jnp.inf, d)
    clear = jnp.min(others, axis=1) > nearest + margin
    mutual = jnp.argmin(d[:, best], axis=0) == jnp.arange(m)
    return jnp.where((nearest < gate) & clear & mutual, best, l).astype(jnp.int32)


def compatible(
    s: Array, residual: Array, rank: Array, *, probability: float = 0.999, rounds: int = 3
) -> Array:
    """Pairs (M,) bool that are left when those that contradict the others are taken out.

    Each pair may lie in its own gate and all of them together make no sense: their errors are
    correlated by the pose. While the joint squared distance is beyond the chi-square bound the pair
    without which it would be least goes, `rounds` times at most.

    Args:
        s: (2 M, 2 M) joint covariance of the residuals; identity where there is no pair.
        residual: (M, 2) zero where there is no pair.
        rank: (M,) int32 numbers of each residual that count: 2, 1, or 0 where there is no pair.
        probability: Of a true set to be within the bound.
        rounds: Pairs that are taken out at most.

    References:
        Neira, Tardos (2001), Data association in stochastic mapping using the joint
        compatibility test, with greedy removal in place of branch and bound.
    """
    m = rank.size
    bound = jnp.asarray(chdtri(np.maximum(np.arange(2 * m + 1), 1), 1 - probability), s.dtype)
    root = inverse_root(s)[0]
    inverse = add_products(jnp.zeros_like(s), root, root)
    v, index = residual.reshape(-1), jnp.arange(m, dtype=jnp.int32)
    u = jnp.sum(inverse * v[None], axis=1)
    for _ in range(rounds):
        blocks = inverse.reshape(m, 2, m, 2)
        a, b, d = (blocks[index, i, index, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        x, y = u.reshape(m, 2).T
        determinant = jnp.maximum(a * d - b * b, 1e-30)
        p, q = (d * x - b * y) / determinant, (a * y - b * x) / determinant
        gain = jnp.where(rank > 0, x * p + y * q, -jnp.inf)
        worst = jnp.argmax(gain).astype(jnp.int32)
        out = (jnp.sum(v * u) > bound[jnp.sum(rank)]) & (rank[worst] > 0)
        # Without the pair: the inverse of S without its rows is a Schur complement of this one.
        two = blocks[:, :, worst].reshape(-1, 2)
        solved = [
            (d[worst] * two[:, 0] - b[worst] * two[:, 1]) / determinant[worst],
            (a[worst] * two[:, 1] - b[worst] * two[:, 0]) / determinant[worst],
        ]
        less = sum(solved[k][:, None] * two[None, :, k] for k in range(2))
        inverse = jnp.where(out, inverse - less, inverse)
        u = jnp.where(out, u - two[:, 0] * p[worst] - two[:, 1] * q[worst], u)
        gone = out & (index == worst)
        rank = jnp.where(gone, 0, rank)
        v = jnp.where(jnp.repeat(gone, 2), 0.0, v)
    return rank > 0


def claim_slots(worth: Array, wanted: Array) -> Array:
    """Slot (M,) int32 for each feature that wants one, in order; L, nowhere, for all others.

    Args:
        worth: (L,) what is lost with each slot; the least go first, infinite ones never.
        wanted: (M,) bool.
    """
    l = worth.size
    less, order = lax.top_k(-worth, min(l, wanted.size))  # of equals the first
    turn = jnp.cumsum(wanted, dtype=jnp.int32) - 1
    at = jnp.clip(turn, 0, order.size - 1)
    free = wanted & (turn < order.size) & (less[at] > -jnp.inf)
    return jnp.where(free, order[at], l).astype(jnp.int32)


def landmarks(
    id: Array, poses: Array, nodes: Nodes, *, least: int = 2, size: int | None = None
) -> Landmarks:
    """Landmarks of a run by the filter's ids, which unlike its slots are never used again.

    Runs on the host. The first guess is the mean of all sightings.

    Args:
        id: (T, M) int32 the filter's landmark of each feature, -1 for none.
        poses: (T, 3) of the filter.
        nodes: [T] features that it was given.
        least: Landmarks that were seen less often are left out.
        size: L, so that several runs have the same; by default as many as there are, or 1.

    Raises:
        ValueError: The shapes do not fit, or there are more than `size` landmarks.
    """
    expect("id", id, nodes.kind.shape, jnp.int32)
    expect("poses", poses, nodes.kind.shape[:1] + (3,), jnp.floating)
    id, is_wall = np.asarray(id), np.asarray(nodes.kind) == WALL
    names, count = np.unique(id[id >= 0], return_counts=True)
    names = names[count >= least]
    size = max(len(names), 1) if size is None else size
    if len(names) > size:
        raise ValueError(f"{len(names)} landmarks are more than size = {size}")
    which = np.where(np.isin(id, names), np.searchsorted(names, id), size)
    kept = which < size
    # Directions of undirected lines are averaged as vectors at twice the angle.
    turned = np.asarray(nodes.direction) + np.asarray(poses)[:, 2:]
    lines = np.stack([np.cos(2 * turned[kept]), np.sin(2 * turned[kept])], axis=-1)
    points = placed(np.asarray(poses)[:, None], np.asarray(nodes.xy))[kept]
    total = np.zeros((size, 2), points.dtype)
    np.add.at(total, which[kept], np.where(is_wall[kept][:, None], lines, points))
    places = total / np.maximum(np.bincount(which[kept], minlength=size), 1)[:, None]
    walls = which[kept & is_wall]
    places[walls, 0] = np.arctan2(total[walls, 1], total[walls, 0]) / 2
    places[walls, 1] = 0.0
    padded = np.pad(names, (0, size - len(names)), constant_values=-1)
    return Landmarks(
        which=jnp.asarray(which, jnp.int32),
        places=jnp.asarray(places, points.dtype),
        id=jnp.asarray(padded, jnp.int32),
    )
