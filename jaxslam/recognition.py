"""Which feature of a scan is which landmark of the belief, and which are new.

Features and landmarks are compared in pairs, (M, L). What is compared has no axis of its own for
the two numbers of an observation: of arrays as small as these, that would be the slow one.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.association import compatible, match
from jaxslam.belief import Belief
from jaxslam.conditioning import Rows
from jaxslam.covariance import blocks_of, rows_at
from jaxslam.geometry import to_world, wrap_angle, wrap_line
from jaxslam.nodes import Nodes
from jaxslam.sensor import differences, expect, observation
from jaxslam.types import CORNER, NODE, WALL, Array
from jaxslam.types import expect as expect_type


class MatchSpec(NamedTuple):
    """When a feature is a landmark; static under jit."""

    gate: float = 9.21  # chi-square of 2 at 99 %
    margin: float = 4.0  # squared distance between the best match and the next
    far: float = 25.0  # squared distance from which a feature may be new
    apart: float = 0.3  # [m] and distance from the next of its kind
    wall_apart: float = 0.26  # [rad] likewise between wall directions
    shape: float = 0.3  # logarithm of the ratio of clearances
    turn: float = 0.5  # [rad] between directions of corners
    lost: float = 0.3  # [m] standard deviation above which a place is believed only if there is
    witness: float = 0.5  # [m] another pair at least so far off that agrees, or after
    looks: int = 2  # scans in a row in which it is met


class Recognised(NamedTuple):
    """What the features of a scan are."""

    slot: Array  # (M,) int32 landmark, L for none
    new: Array  # (M,) bool, to be taken in
    at: Array | None  # (M,) int32 slot that each is to get then; None: any


def distances(belief: Belief, nodes: Nodes, noise: Array) -> Array:
    """Squared Mahalanobis distance (M, L) of every feature to every slot.

    Args:
        belief: Predicted belief.
        nodes: Features of the scan.
        noise: (M, 2, 2) their covariance.
    """
    size = belief.seen.size
    expected, by_pose, by_slot = jax.vmap(expect, in_axes=(None, 0, 0))(
        belief.pose, belief.places, belief.kind
    )
    across = belief.cross_cov.reshape(3, size, 2).transpose(1, 0, 2)  # (L, 3, 2)
    own = blocks_of(belief.map_cov)
    mixed = jnp.einsum("lij,ljk,lmk->lim", by_pose, across, by_slot)
    spread = jnp.einsum("lij,jk,lmk->lim", by_pose, belief.pose_cov, by_pose)
    spread += mixed + jnp.swapaxes(mixed, 1, 2)
    spread += jnp.einsum("lij,ljk,lmk->lim", by_slot, own, by_slot)
    entry = lambda i, j: spread[None, :, i, j] + noise[:, None, i, j]
    a, b, d = entry(0, 0), 0.5 * (entry(0, 1) + entry(1, 0)), entry(1, 1)
    seen = observation(nodes)
    off = (seen[:, None, k] - expected[None, :, k] for k in range(2))
    return _square(a, b, d, *differences(*off, (belief.kind == WALL)[None]))


def _square(a: Array, b: Array, d: Array, x: Array, y: Array) -> Array:
    """Squared Mahalanobis norms of (x, y) by covariances [[a, b], [b, d]], all of one shape."""
    determinant = jnp.maximum(a * d - b * b, 1e-12)
    return (d * x * x - 2 * b * x * y + a * y * y) / determinant


def alike(belief: Belief, nodes: Nodes, *, shape: float, turn: float) -> Array:
    """Pairs (M, L) bool of feature and slot that could be one thing, wherever they are.

    Same kind; nodes of like clearance (`shape`, in logarithm), corners of like angle that face
    like directions (`turn` [rad]).
    """
    same = nodes.kind[:, None] == belief.kind[None]
    same &= (belief.seen > 0)[None] & nodes.valid[:, None]
    facing = nodes.direction[:, None] + belief.pose[2] - belief.direction[None]
    shapes = nodes.shape[:, None], belief.shape[None]
    return same & _resemble(nodes.kind[:, None], *shapes, facing, shape=shape, turn=turn)


def _resemble(
    kind: Array, one: Array, other: Array, facing: Array, *, shape: float, turn: float
) -> Array:
    """Whether things of one kind look alike, by their two shapes and what they face apart [rad]."""
    clearance = jnp.abs(jnp.log(jnp.maximum(one, 1e-3) / jnp.maximum(other, 1e-3))) < shape
    corner = (jnp.abs(wrap_angle(facing)) < turn) & (jnp.abs(one - other) < turn)
    return jnp.where(kind == NODE, clearance, jnp.where(kind == CORNER, corner, True))


def unlike(spec: MatchSpec, belief: Belief, nodes: Nodes, distance: Array) -> Array:
    """Features (M,) bool that are far from all landmarks of their kind."""
    same = (nodes.kind[:, None] == belief.kind[None]) & (belief.seen > 0)[None]
    place, known = to_world(belief.pose, nodes.xy), belief.places
    x, y = place[:, None, 0] - known[None, :, 0], place[:, None, 1] - known[None, :, 1]
    turn = nodes.direction[:, None] + belief.pose[2] - known[None, :, 0]
    is_wall = (nodes.kind == WALL)[:, None]
    near = (x * x + y * y < spec.apart**2) | (distance < spec.far)
    near = jnp.where(is_wall, jnp.abs(wrap_line(turn)) < spec.wall_apart, near)
    return nodes.valid & ~jnp.any(same & near, axis=1)


def recognise(spec: MatchSpec, belief: Belief, nodes: Nodes, noise: Array) -> Recognised:
    """Match features to landmarks by their distance and what they look like.

    Args:
        spec: When a feature is a landmark.
        belief: Predicted belief.
        nodes: Features of the scan.
        noise: (M, 2, 2) their covariance.
    """
    distance = lax.stop_gradient(distances(belief, nodes, noise))
    possible = alike(belief, nodes, shape=spec.shape, turn=spec.turn)
    slot = match(distance, possible, gate=spec.gate, margin=spec.margin)
    new = (slot == belief.seen.size) & unlike(spec, belief, nodes, distance)
    return Recognised(slot, new, None)


def second_look(
    spec: MatchSpec, belief: Belief, nodes: Nodes, rows: Rows, s: Array
) -> tuple[Array, Array]:
    """Pairs (M,) bool to be believed, and the number of looks (L,) at each landmark so far.

    Pairs that contradict the others are not believed. A place that was lost from sight for long is
    met again within a gate that may be wide enough for other places: such a pair needs a witness
    in the same scan, another pair as far from it as the map says, or `spec.looks` scans in a row.

    Args:
        spec: When a feature is a landmark.
        belief: Predicted belief.
        nodes: Features that are matched.
        rows: Their innovations; zero where there is no match.
        s: (2 M, 2 M) covariance of the innovations.
    """
    m, size = rows.slot.size, belief.seen.size
    index = jnp.arange(m, dtype=jnp.int32)
    pair = jnp.any(rows.by_slot != 0.0, axis=(1, 2))
    place = pair & (nodes.kind != WALL)
    rank = jnp.where(pair, jnp.where(nodes.kind == WALL, 1, 2), 0).astype(jnp.int32)
    agrees = compatible(s, rows.residual, rank)

    spread = s.reshape(m, 2, m, 2)[index, :, index] - rows.noise
    far2 = jnp.sum(nodes.xy**2, axis=1)
    doubtful = place & (spread[:, 0, 0] + far2 * spread[:, 1, 1] > spec.lost**2)

    apart = lambda xy: jnp.sqrt(
        (xy[:, None, 0] - xy[None, :, 0]) ** 2 + (xy[:, None, 1] - xy[None, :, 1]) ** 2 + 1e-6
    )
    seen, known = apart(nodes.xy), apart(belief.places[rows.slot])
    variance = rows_at(belief.map_cov, rows.slot).reshape(m, 2, size, 2)[:, :, rows.slot]
    own = variance[index, :, index]
    trace = lambda x: x[..., 0, 0] + x[..., 1, 1]
    of_map = trace(own)[:, None] + trace(own)[None] - 2 * trace(jnp.moveaxis(variance, 2, 1))
    of_scan = rows.noise[:, 0, 0] + far2 * rows.noise[:, 1, 1]
    of_pair = of_map + of_scan[:, None] + of_scan[None]
    rigid = (seen - known) ** 2 < spec.gate * jnp.maximum(of_pair, 0.0)
    rigid &= (seen > spec.witness) & (place & agrees)[None] & (index[:, None] != index[None])
    sure = jnp.any(rigid, axis=1) | (belief.looks[rows.slot] + 1 >= spec.looks)
    believed = agrees & (~doubtful | sure)
    waits = place & agrees & ~believed
    looks = belief.looks.at[jnp.where(believed, rows.slot, size)].set(0, mode="drop")
    return believed, looks.at[jnp.where(waits, rows.slot, size)].add(1, mode="drop")


def overdue(belief: Belief, view: tuple[float, float]) -> Array:
    """Nodes (L,) bool that a scan cannot miss, if they are there.

    Nothing stands in the circle of a node: from within, it is in sight. Only half of the circle is
    taken, for the errors of both.

    Args:
        belief: Belief.
        view: Bearings [rad] from which to which the scanner sees.
    """
    offset = belief.places - belief.pose[None, :2]
    away = jnp.sqrt(jnp.sum(offset**2, axis=1))
    bearing = wrap_angle(jnp.arctan2(offset[:, 1], offset[:, 0]) - belief.pose[2])
    whole = view[1] - view[0] >= 2 * jnp.pi - 0.1
    seen = whole | ((bearing > view[0] + 0.2) & (bearing < view[1] - 0.2))
    near = (away < belief.shape / 2) & (away > 0.1)
    return (belief.kind == NODE) & (belief.seen > 0) & near & seen


def twin(spec: MatchSpec, belief: Belief, slot: Array) -> Array:
    """Slot () of a landmark that is the one of `slot` () once more, L for none.

    Both are places of one kind, look alike, and are nearer than any two landmarks may be new, by
    distance and by their covariance.
    """
    size = belief.seen.size
    at = jnp.minimum(slot, size - 1)
    place, kind, shape = belief.places, belief.kind, belief.shape
    x, y = (place - place[at][None]).T
    own, index = blocks_of(belief.map_cov), jnp.arange(size, dtype=jnp.int32)
    # (L, 2, 2) of the slot and each.
    across = rows_at(belief.map_cov, at[None]).reshape(2, size, 2).transpose(1, 0, 2)
    s = own + own[at][None] - across - jnp.swapaxes(across, 1, 2)
    distance = _square(s[:, 0, 0] + 1e-4, s[:, 0, 1], s[:, 1, 1] + 1e-4, x, y)
    facing = belief.direction - belief.direction[at]
    same = _resemble(kind, shape, shape[at], facing, shape=spec.shape, turn=spec.turn)
    same &= (kind == kind[at]) & (kind != WALL) & (belief.seen > 0) & (index != at)
    same &= (x * x + y * y < spec.apart**2) & (distance < spec.gate) & (slot < size)
    best = jnp.argmin(jnp.where(same, distance, jnp.inf))
    return jnp.where(jnp.any(same), best, size).astype(jnp.int32)


def identify(belief: Belief, nodes: Nodes, known: Array) -> Recognised:
    """Take features for the landmarks they are said to be; of several that are one, the first.

    Args:
        belief: Predicted belief.
        nodes: Features of the scan.
        known: (M,) int32 landmark of each, -1 for none.

    Raises:
        ValueError: `known` has another shape or type than the features; while tracing.
    """
    expect_type("inputs.known", known, nodes.kind.shape, jnp.int32)
    size = belief.seen.size
    given = nodes.valid & (known >= 0) & (known < size)
    same = (known[:, None] == known[None]) & given[None]
    given &= ~jnp.any(jnp.tril(same, -1), axis=1)
    at = jnp.where(given, known, size)
    old = belief.seen.at[at].get(mode="fill", fill_value=0) > 0
    return Recognised(jnp.where(old, at, size), given & ~old, at)
