"""Data association of two submaps: which landmarks of one are in the other, given a guess.

The guess is the pose of the second submap's frame in the first's, with covariance, as the submaps
joined so far have it. With Sigma its covariance, T it itself, and p a landmark of the second,

    v = q_first - T p_second        S = J Sigma J^T + R P_second R^T + P_first

    round 1    gated mutual nearest neighbours by v and S, without those that are ambiguous
               the joint compatibility test of all of them
    between    T and Sigma conditioned on these matches
    round 2    the same with the better T; the joint test with Sigma of the guess

Round 1 finds few where the guess is poor, round 2 the rest. Correlations of the guess with the
submaps are left out: they are in the errors of both sides of v, so that S is rather too large. It
only gates; no estimate is made with it.

References:
    Neira, Tardos (2001), Data association in stochastic mapping using the joint compatibility test,
    with greedy removal in place of branch and bound. Bosse, Newman, Leonard, Teller (2004), SLAM in
    large-scale cyclic environments using the Atlas framework.
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from jaxslam.core import se2_np
from jaxslam.core.batching import pad_to
from jaxslam.core.types import Array
from jaxslam.filtering.data_association import AssociationSpec, similar_descriptors
from jaxslam.filtering.submaps import Submap

BLOCK = 32  # landmarks: the program that compares descriptors is compiled for multiples of it
JOINT_PROBABILITY = 0.999  # that right matches pass the joint test
LEAST_KEPT = 0.5  # of the matches, that the joint test must leave


def match_submaps(
    spec: AssociationSpec,
    first: Submap,
    second: Submap,
    relative_pose: np.ndarray,
    relative_cov: np.ndarray,
    *,
    min_matches: int = 3,
) -> np.ndarray:
    """The landmark of the first submap that each landmark of the second is.

    Args:
        spec: Thresholds of data association.
        first: Submap of n landmarks.
        second: Submap of m landmarks.
        relative_pose: (3,) [m, m, rad] guess of the second's frame in the first's.
        relative_cov: (3, 3) its covariance.
        min_matches: Fewer matches are none.

    Returns:
        (m,) int index in the first submap, -1 for none; no index twice.
    """
    none = np.full(len(second.positions), -1)
    if min(len(first.positions), len(second.positions)) < min_matches:
        return none
    possible = _possible(spec, first, second, relative_pose[2])
    pair = _Pair(first, second, relative_cov)
    pose, cov = relative_pose, relative_cov
    for _ in range(2):
        found = _nearest(spec, pair, possible, pose, cov)
        kept = _jointly_compatible(pair, relative_pose, found)
        if len(kept[0]) < max(min_matches, LEAST_KEPT * len(found[0])):
            return none
        pose, cov = _conditioned(pair, relative_pose, kept)
    none[kept[1]] = kept[0]
    return none


class _Pair(NamedTuple):
    """Two submaps, and the covariance (3, 3) of the guess of their relative pose."""

    first: Submap
    second: Submap
    relative_cov: np.ndarray


Found = tuple[np.ndarray, np.ndarray]
"""Indices (k,) of matched landmarks of the first submap, and (k,) of the second."""


def _possible(spec: AssociationSpec, first: Submap, second: Submap, rotation: float) -> np.ndarray:
    """Pairs (m, n) bool of equal kind and similar descriptor."""

    def padded(x: np.ndarray) -> np.ndarray:
        return pad_to(x, to=-(-len(x) // BLOCK) * BLOCK)

    sides = [tuple(map(padded, (s.kind, s.descriptor, s.direction))) for s in (second, first)]
    result = np.asarray(_similar(spec, *sides[0], *sides[1], np.asarray(rotation)))
    return result[: len(second.kind), : len(first.kind)]


@partial(jax.jit, static_argnames="spec")
def _similar(
    spec: AssociationSpec,
    kind: Array,
    descriptor: Array,
    direction: Array,
    other_kind: Array,
    other_descriptor: Array,
    other_direction: Array,
    rotation: Array,
) -> Array:
    """Pairs (m, n) bool of equal kind and similar descriptor; padding is not left out."""
    return (kind[:, None] == other_kind[None]) & similar_descriptors(
        kind[:, None],
        descriptor[:, None],
        other_descriptor[None],
        direction[:, None] + rotation - other_direction[None],
        max_log_clearance_ratio=spec.max_log_clearance_ratio,
        max_corner_difference=spec.max_corner_difference,
    )


def _point_blocks(cov: np.ndarray) -> np.ndarray:
    """Covariances (n, 2, 2) of the landmarks of a submap, of its covariance (3 + 2 n, 3 + 2 n)."""
    n = len(cov) // 2 - 1
    index = np.arange(n)
    return cov[3:, 3:].reshape(n, 2, n, 2)[index, :, index]


def _transformed(pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (k, 2) in the other frame, their derivatives (k, 2, 3) by the pose, and R (2, 2)."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    moved = se2_np.transform(pose, points)
    lever = moved - pose[:2]
    by_pose = np.zeros((len(points), 2, 3))
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = 1.0
    by_pose[:, :, 2] = np.stack([-lever[:, 1], lever[:, 0]], axis=1)
    return moved, by_pose, np.array([[cos, -sin], [sin, cos]])


def _nearest(
    spec: AssociationSpec, pair: _Pair, possible: np.ndarray, pose: np.ndarray, cov: np.ndarray
) -> Found:
    """Gated mutual nearest neighbours, without those whose second nearest is almost as near."""
    moved, by_pose, turn = _transformed(pose, pair.second.positions)
    own = by_pose @ cov @ by_pose.swapaxes(1, 2)
    own += turn @ _point_blocks(pair.second.cov) @ turn.T
    s = own[:, None] + _point_blocks(pair.first.cov)[None]
    x, y = np.moveaxis(pair.first.positions[None] - moved[:, None], -1, 0)
    a, b, d = s[..., 0, 0], s[..., 0, 1], s[..., 1, 1]
    distance = (d * x * x - 2 * b * x * y + a * y * y) / np.maximum(a * d - b * b, 1e-18)
    distance = np.where(possible, distance, np.inf)
    index = np.arange(len(distance))
    best = distance.argmin(axis=1)
    nearest = distance[index, best]
    others = distance.copy()
    others[index, best] = np.inf
    accepted = (nearest < spec.gate) & (others.min(axis=1) > nearest + spec.ambiguity_margin)
    accepted &= distance.argmin(axis=0)[best] == index
    return best[accepted], index[accepted]


def _innovation(
    pair: _Pair, pose: np.ndarray, found: Found
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residual v (2 k,), minus its derivative (2 k, 3) by the pose, and its covariance given it.

    The landmarks of a submap are correlated: the covariance (2 k, 2 k) is that of all together.
    """
    of_first, of_second = found
    moved, by_pose, turn = _transformed(pose, pair.second.positions[of_second])
    residual = (pair.first.positions[of_first] - moved).reshape(-1)
    covs = [_joint(s.cov, at) for s, at in ((pair.first, of_first), (pair.second, of_second))]
    turned = np.einsum("ij,kjlm,nm->kiln", turn, covs[1], turn)
    size = residual.size
    return residual, by_pose.reshape(size, 3), (covs[0] + turned).reshape(size, size)


def _joint(cov: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Covariance (k, 2, k, 2) of some landmarks (k,) of a submap."""
    n = len(cov) // 2 - 1
    return cov[3:, 3:].reshape(n, 2, n, 2)[at][:, :, at]


def _jointly_compatible(pair: _Pair, pose: np.ndarray, found: Found) -> Found:
    """The matches that are left when those that contradict the others are removed.

    As `filtering.compatibility.jointly_compatible`, of any number of matches, until the test is
    passed. Without match k, v^T S^-1 v is less by u_k^T W_kk^-1 u_k, where W = S^-1 and u = W v.
    """
    from scipy.special import chdtri  # imported here, because it is slow to import

    while len(found[0]):
        v, by_pose, s = _innovation(pair, pose, found)
        w = np.linalg.inv(s + by_pose @ pair.relative_cov @ by_pose.T)
        u = w @ v
        if v @ u <= chdtri(v.size, 1 - JOINT_PROBABILITY):
            break
        k = len(found[0])
        own = w.reshape(k, 2, k, 2)[np.arange(k), :, np.arange(k)]
        per_match = u.reshape(k, 2)
        gain = np.einsum("ki,kij,kj->k", per_match, np.linalg.inv(own), per_match)
        left = np.arange(k) != gain.argmax()
        found = found[0][left], found[1][left]
    return found


def _conditioned(pair: _Pair, pose: np.ndarray, found: Found) -> tuple[np.ndarray, np.ndarray]:
    """The relative pose and its covariance, given matches: a Kalman update."""
    v, by_pose, s = _innovation(pair, pose, found)
    cross = pair.relative_cov @ by_pose.T
    gain = np.linalg.solve(by_pose @ cross + s, cross.T).T
    cov = pair.relative_cov - gain @ cross.T
    return pose + gain @ v, (cov + cov.T) / 2
