"""The topological map: arcs between the landmarks of the filter, merged scan by scan.

The nodes of the map are the landmarks themselves; the map adds which of them a branch of some
scan's Voronoi diagram joins. Arcs name landmarks by id, so they stay when landmarks move.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.association import claim_slots
from jaxslam.ekf import Belief
from jaxslam.geometry import to_world
from jaxslam.links import Links
from jaxslam.types import CORNER, NODE, Array


class Arcs(NamedTuple):
    """Arcs of the map in fixed slots."""

    ends: Array  # (A, 2) int32 landmark ids, the smaller first; -1 in free slots
    via: Array  # (A, 2) [m] world, a point half-way along the arc
    clearance: Array  # (A,) [m] smallest seen on it
    seen: Array  # (A,) int32 how often it was seen; 0 marks a free slot


class Graph(NamedTuple):
    """The map as a graph, NumPy, world frame; nothing is padding."""

    id: np.ndarray  # (N,) int
    xy: np.ndarray  # (N, 2) [m]
    kind: np.ndarray  # (N,) int NODE or CORNER; arcs join nodes only
    clearance: np.ndarray  # (N,) [m] of a node, 0 for a corner
    pairs: np.ndarray  # (A, 2) int, indices of the two ends
    length: np.ndarray  # (A,) [m]
    arc_clearance: np.ndarray  # (A,) [m], NaN where it was driven but not seen
    via: np.ndarray  # (A, 2) [m] a point half-way


def empty(*, arcs: int) -> Arcs:
    """No arcs, room for A of them."""
    return Arcs(
        ends=jnp.full((arcs, 2), -1, jnp.int32),
        via=jnp.zeros((arcs, 2)),
        clearance=jnp.zeros(arcs),
        seen=jnp.zeros(arcs, jnp.int32),
    )


def add(arcs: Arcs, ids: Array, pose: Array, links: Links) -> Arcs:
    """Merge the links of one scan.

    Args:
        arcs: The arcs so far.
        ids: (M,) int32 landmark id of each feature of the scan, -1 for none.
        pose: (3,) estimated pose of the scan.
        links: Branches of the scan that join two features.
    """
    size = arcs.seen.size
    ends = jnp.sort(ids[links.pair], axis=1)  # (P, 2)
    good = links.valid & (ends[:, 0] >= 0) & (ends[:, 0] != ends[:, 1])
    via = to_world(pose, links.via)
    same = jnp.all(ends[:, None] == arcs.ends[None], axis=2) & (arcs.seen > 0)[None]  # (P, A)
    known = jnp.any(same, axis=1)
    fresh = claim_slots(arcs.seen == 0, good & ~known)
    slot = jnp.where(known, jnp.argmax(same, axis=1).astype(jnp.int32), fresh)
    slot = jnp.where(good, slot, size)
    narrow = jnp.where(known, arcs.clearance[jnp.minimum(slot, size - 1)], jnp.inf)
    return Arcs(
        ends=arcs.ends.at[slot].set(ends, mode="drop"),
        via=arcs.via.at[slot].set(via.astype(arcs.via.dtype), mode="drop"),
        clearance=arcs.clearance.at[slot].set(
            jnp.minimum(narrow, links.clearance).astype(arcs.clearance.dtype), mode="drop"
        ),
        seen=arcs.seen.at[slot].add(1, mode="drop"),
    )


def build(ids: Array, poses: Array, links: Links, *, arcs: int) -> Arcs:
    """Arcs of a whole run from its ids (T, M), estimated poses (T, 3) and links [T]."""

    def body(now: Arcs, step: tuple[Array, Array, Links]) -> tuple[Arcs, None]:
        return add(now, *step), None

    return lax.scan(body, empty(arcs=arcs), (ids, poses, links))[0]


def trail(xy: np.ndarray, clearance: np.ndarray, poses: np.ndarray) -> dict:
    """Pairs of nodes that the robot drove between, with the point half-way between them.

    The robot is at a node while it is inside its circle, at the nearest where circles overlap.

    Args:
        xy: (N, 2) [m] positions of the nodes.
        clearance: (N,) [m] radii of their circles.
        poses: (T, 3) where the robot was.

    Returns:
        Dict of pairs (the smaller index first) to the point (2,) [m, world].
    """
    found: dict[tuple[int, int], np.ndarray] = {}
    here, since = -1, 0
    for step, pose in enumerate(np.asarray(poses, float)):
        away = np.linalg.norm(xy - pose[:2], axis=1)
        inside = np.where(away < clearance, away, np.inf)
        now = int(np.argmin(inside)) if np.isfinite(inside).any() else -1
        if now >= 0 and here >= 0 and now != here:
            both = [(since + step) // 2, (since + step + 1) // 2]
            middle = np.mean(np.asarray(poses, float)[both, :2], axis=0)
            found.setdefault((min(here, now), max(here, now)), middle)
        if now >= 0:
            here, since = now, step
    return found


def graph(belief: Belief, arcs: Arcs, poses: np.ndarray, *, confirm: int) -> Graph:
    """The map as it stands: landmarks that count, and the arcs between them.

    Two nodes are joined by an arc where a branch of a scan's diagram joins them, and where the
    robot drove from one to the other; the clearance of the latter is NaN, it was not measured.

    Args:
        belief: The landmarks.
        arcs: Branches seen.
        poses: (T, 3) estimated poses of the scans.
        confirm: Sightings from which a landmark counts.
    """
    seen, kind, id = (np.asarray(x) for x in (belief.seen, belief.kind, belief.id))
    keep = np.flatnonzero((seen >= confirm) & np.isin(kind, (NODE, CORNER)))
    xy = np.asarray(belief.places, float)[keep]
    index = {int(i): n for n, i in enumerate(id[keep]) if kind[keep[n]] == NODE}
    used = [
        (index[a], index[b], k)
        for k, (a, b) in enumerate(np.asarray(arcs.ends).tolist())
        if a in index and b in index and arcs.seen[k] > 0
    ]
    pairs = np.array([u[:2] for u in used], int).reshape(-1, 2)
    at = [u[2] for u in used]
    via = np.asarray(arcs.via, float)[at].reshape(-1, 2)
    room = np.asarray(arcs.clearance, float)[at]
    clearance = np.where(kind[keep] == NODE, np.asarray(belief.shape, float)[keep], 0.0)
    seen_pairs = {tuple(sorted(pair)) for pair in pairs.tolist()}
    driven = {k: v for k, v in trail(xy, clearance, poses).items() if k not in seen_pairs}
    if driven:
        pairs = np.concatenate([pairs, np.array(list(driven))])
        via = np.concatenate([via, np.array(list(driven.values()))])
        room = np.concatenate([room, np.full(len(driven), np.nan)])
    length = sum(np.linalg.norm(xy[pairs[:, k]] - via, axis=1) for k in range(2))
    return Graph(
        id=id[keep],
        xy=xy,
        kind=kind[keep],
        clearance=clearance,
        pairs=pairs,
        length=length,
        arc_clearance=room,
        via=via,
    )
