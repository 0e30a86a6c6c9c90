"""The topological map: arcs between the landmarks of the filter, merged scan by scan.

The nodes of the map are the landmarks themselves; the map adds which of them a branch of some
scan's Voronoi diagram joins. Arcs name landmarks by id and keep their line as it was seen, from
one end to the other: laid between the landmarks where these are now, it moves with them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam import programs, ways
from jaxslam.association import claim_slots
from jaxslam.belief import Belief
from jaxslam.geometry import to_robot, to_world, unit
from jaxslam.lidar import Lidar, Scan, before_ends
from jaxslam.links import LINE, TWIN, Links, gap, repeated
from jaxslam.types import CORNER, NODE, Array
from jaxslam.ways import Way

ROOM = 0.4  # [m] around the end of a frontier that must be seen for it to be explored
SKIN = 0.2  # [m] behind what was hit there is wall
SAME_END = 1.0  # [m] ends of frontiers of one node this close are one
CHORD = 0.3  # [m] between two ends from which their direction turns the line between them
AROUND = 64  # ends of frontiers that are looked around in one scan at most, the nearest
TWINS = 8  # arcs of the same ends that are compared with a link at most
THROUGH = 0.5  # of its clearance: an arc this close to a node goes through it


class Arcs(NamedTuple):
    """Arcs and frontiers of the map in fixed slots."""

    ends: Array  # (A, 2) int32 landmark ids, the smaller first; -1 second at a frontier
    line: Array  # (A, K, 2) [m] mean of what was seen, in the frame it was seen in last
    length: Array  # (A,) [m] mean
    clearance: Array  # (A,) [m] smallest seen on it
    seen: Array  # (A,) int32 how often it was seen; 0 marks a free slot


class Graph(NamedTuple):
    """The map as a graph, NumPy, world frame; nothing is padding."""

    id: np.ndarray  # (N,) int
    xy: np.ndarray  # (N, 2) [m]
    kind: np.ndarray  # (N,) int NODE or CORNER; arcs join nodes only
    clearance: np.ndarray  # (N,) [m] of a node, 0 for a corner
    pairs: np.ndarray  # (A, 2) int, indices of the two ends; (i, i) is a loop, a pair may recur
    length: np.ndarray  # (A,) [m]
    arc_clearance: np.ndarray  # (A,) [m], NaN where it was driven but not seen
    lines: tuple[np.ndarray, ...]  # A polylines (n >= 2, 2) [m], first end to second
    frontiers: tuple[np.ndarray, ...] = ()  # F polylines (n >= 2, 2) [m], from a node to where
    frontier_of: np.ndarray = np.zeros(0, int)  # (F,) the view ended; index of that node


def empty(*, arcs: int) -> Arcs:
    """No arcs, room for A of them."""
    return Arcs(
        ends=jnp.full((arcs, 2), -1, jnp.int32),
        line=jnp.zeros((arcs, LINE, 2)),
        length=jnp.zeros(arcs),
        clearance=jnp.zeros(arcs),
        seen=jnp.zeros(arcs, jnp.int32),
    )


def grown(arcs: Arcs, size: int) -> Arcs:
    """The arcs in more slots, A of them."""
    return jax.tree.map(lambda old, new: new.at[: len(old)].set(old), arcs, empty(arcs=size))


def attach(line: Array, first: Array, last: Array) -> Array:
    """Lay a line between two places: turned with its chord, what is left shared out along it.

    Args:
        line: (..., K, 2) [m] points at equal distances.
        first: (..., 2) [m] where it shall begin.
        last: (..., 2) [m] where it shall end.
    """
    old, new = line[..., -1, :] - line[..., 0, :], last - first
    both = jnp.stack([old, new], axis=-2)
    firm = jnp.min(jnp.linalg.norm(both, axis=-1), axis=-1) > CHORD
    x, y = both[..., 0], both[..., 1]
    cosine = jnp.where(firm, x[..., 0] * x[..., 1] + y[..., 0] * y[..., 1], 1.0)
    sine = jnp.where(firm, x[..., 0] * y[..., 1] - y[..., 0] * x[..., 1], 0.0)
    size = jnp.hypot(cosine, sine)
    c, s = (cosine / size)[..., None], (sine / size)[..., None]
    own = line - line[..., :1, :]
    turned = jnp.stack(
        [c * own[..., 0] - s * own[..., 1], s * own[..., 0] + c * own[..., 1]], axis=-1
    )
    rest = (new - turned[..., -1, :])[..., None, :]
    part = jnp.linspace(0.0, 1.0, line.shape[-2], dtype=line.dtype)[:, None]
    return first[..., None, :] + turned + part.reshape((1,) * (line.ndim - 2) + part.shape) * rest


_attach = programs.jit(attach)


def _explored(arcs: Arcs, pose: Array, scan: Scan, lidar: Lidar) -> Array:
    """Slots (AROUND,) of frontiers whose end, and all around it, a scan sees to be free or wall.

    A for none. Few ends are in view: it is looked around those alone.
    """
    size = arcs.seen.size
    reach = scan.ranges + jnp.where(scan.hit, SKIN, 0.0).astype(scan.ranges.dtype)
    own = to_robot(pose, arcs.line[:, -1])
    seen = before_ends(own, reach, lidar) & (arcs.ends[:, 1] < 0) & (arcs.seen > 0)
    away = jnp.where(seen, jnp.sum(own**2, axis=1), jnp.inf)
    less, slot = lax.top_k(-away, min(AROUND, size))
    rim = ROOM * unit(jnp.linspace(-jnp.pi, jnp.pi, 8, endpoint=False, dtype=pose.dtype))
    rim = to_robot(pose, rim[None] + arcs.line[slot, -1:])  # (AROUND, 8, 2)
    all_round = (less > -jnp.inf) & jnp.all(before_ends(rim, reach, lidar), axis=1)
    return jnp.where(all_round, slot, size).astype(jnp.int32)


def _check(ids: Array, pose: Array, links: Links, scan: Scan, lidar: Lidar) -> None:
    """Raise ValueError if shapes or types do not fit."""
    if ids.ndim != 1 or not jnp.issubdtype(ids.dtype, jnp.integer):
        raise ValueError(f"ids is {ids.dtype} {ids.shape}, not integers (M,)")
    count = links.valid.shape[0]
    told = (("pose", pose, (3,)), ("links.pair", links.pair, (count, 2)))
    told += (("links.line", links.line, (count, LINE, 2)),)
    for name, x, shape in (*told, ("scan.ranges", scan.ranges, (lidar.beams,))):
        if x.shape != shape:
            raise ValueError(f"{name} is {x.shape}, not {shape}")


def add(arcs: Arcs, ids: Array, pose: Array, links: Links, scan: Scan, lidar: Lidar) -> Arcs:
    """Merge the links of one scan.

    A link is an arc that is known if it has the same ends and, laid between the same places, about
    the same line. A frontier is dropped when all around its end is seen, else its longest line
    stands.

    Args:
        arcs: The arcs so far.
        ids: (M,) int32 landmark id of each feature of the scan, -1 for none.
        pose: (3,) estimated pose of the scan.
        links: Branches of the scan.
        scan: The scan.
        lidar: The scanner.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    _check(ids, pose, links, scan, lidar)
    arcs = _forget(arcs, _explored(arcs, pose, scan, lidar))
    size = arcs.seen.size
    frontier = links.pair[:, 1] < 0
    ends = jnp.where(links.pair < 0, -1, ids[links.pair])
    line = to_world(pose, links.line).astype(arcs.line.dtype)
    swap = ~frontier & (ends[:, 0] > ends[:, 1])
    ends = jnp.where(swap[:, None], ends[:, ::-1], ends)
    line = jnp.where(swap[:, None, None], line[:, ::-1], line)
    good = links.valid & (ends[:, 0] >= 0) & (frontier | (ends[:, 1] >= 0))
    good &= (ends[:, 0] != ends[:, 1]) & jnp.all(jnp.isfinite(line), axis=(1, 2))
    good &= ~repeated(ends, line, good)

    # The arcs with the ends of each link, (P, TWINS), laid on it.
    alike = (ends[:, :1] == arcs.ends[None, :, 0]) & (ends[:, 1:] == arcs.ends[None, :, 1])
    alike, other = lax.top_k(alike.astype(line.dtype), min(TWINS, size))
    old = arcs.line[other]
    first = jnp.broadcast_to(line[:, None, 0], (*other.shape, 2))
    last = jnp.where(frontier[:, None, None], first + old[:, :, -1] - old[:, :, 0],
                     jnp.broadcast_to(line[:, None, -1], first.shape))  # fmt: skip
    laid = attach(old, first, last)
    off = jnp.where(
        frontier[:, None],
        jnp.linalg.norm(laid[:, :, -1] - line[:, None, -1], axis=-1) * (TWIN / SAME_END),
        gap(laid, line[:, None]),
    )
    same = (alike > 0.0) & (off < TWIN)
    known = jnp.any(same, axis=1)
    nearest = jnp.argmin(jnp.where(same, off, jnp.inf), axis=1)[:, None]
    best = jnp.take_along_axis(other, nearest, axis=1)[:, 0].astype(jnp.int32)
    # Two links on one arc: the nearer counts.
    rival = (best[:, None] == best[None]) & (known & good)[None] & known[:, None]
    mine = jnp.min(jnp.where(same, off, jnp.inf), axis=1)
    earlier = jnp.tril(jnp.ones(rival.shape, bool), -1)
    worse = (mine[None] < mine[:, None]) | ((mine[None] == mine[:, None]) & earlier)
    good &= ~jnp.any(rival & worse, axis=1)

    fresh = claim_slots(jnp.where(arcs.seen == 0, 0.0, jnp.inf), good & ~known)
    slot = jnp.where(good, jnp.where(known, best, fresh), size)
    at = jnp.minimum(slot, size - 1)
    part = jnp.where(known, 1.0 / (arcs.seen[at] + 1).astype(line.dtype), 1.0)
    longer = (links.length > arcs.length[at]).astype(line.dtype)
    part = jnp.where(frontier & known, longer, part)
    own = jnp.take_along_axis(laid, nearest[:, :, None, None], axis=1)[:, 0]
    before = jnp.where(known[:, None, None], own, line)
    narrow = jnp.where(known, arcs.clearance[at], jnp.inf)
    mix = lambda old, new, w: old + w * (new - old)
    changes = Arcs(
        ends=ends,
        line=mix(before, line, part[:, None, None]),
        length=mix(arcs.length[at], jnp.where(good, links.length, 0.0), part),
        clearance=jnp.minimum(narrow, links.clearance),
        seen=jnp.where(known, arcs.seen[at], 0) + 1,
    )
    put = lambda old, new: old.at[slot].set(new.astype(old.dtype), mode="drop")
    return jax.tree.map(put, arcs, changes)


def _forget(arcs: Arcs, gone: Array) -> Arcs:
    """Free some slots; A for none."""
    free = lambda x, what: x.at[gone].set(jnp.int32(what), mode="drop")
    return arcs._replace(ends=free(arcs.ends, -1), seen=free(arcs.seen, 0))


def _nodes(
    belief: Belief, confirm: int, apart: float, alike: float
) -> tuple[np.ndarray, dict[int, int]]:
    """Slots of the landmarks of the graph, and the index in it of every node landmark's id.

    Nodes `apart` [m] at most, with clearances `alike`, are one: that of the smallest id.
    """
    seen, kind, id = (np.asarray(x) for x in (belief.seen, belief.kind, belief.id))
    xy, size = np.asarray(belief.places, float), np.log(np.maximum(belief.shape, 1e-3))
    slots = np.flatnonzero((seen > 0) & (kind == NODE))
    counts = seen[slots] >= confirm
    near = np.linalg.norm(xy[slots, None] - xy[None, slots], axis=2) < apart
    near &= np.abs(size[slots, None] - size[None, slots]) < alike
    # The smallest id first; each takes what is near it and not yet taken.
    stands = np.full(len(slots), -1)
    for k in sorted(np.flatnonzero(counts), key=lambda k: id[slots[k]]):
        if stands[k] < 0:
            stands[near[k] & (stands < 0)] = k
    keep = np.concatenate([slots[np.unique(stands[stands >= 0])],
                           np.flatnonzero((seen >= confirm) & (kind == CORNER))])  # fmt: skip
    keep = np.sort(keep)
    rank = {int(slot): n for n, slot in enumerate(keep)}
    named = zip(slots, stands, strict=True)
    return keep, {int(id[a]): rank[int(slots[b])] for a, b in named if b >= 0}


def _seen_ways(arcs: Arcs, index: dict[int, int], xy: np.ndarray) -> list[Way]:
    """Arcs and frontiers, laid between nodes (N, 2) of the graph by the index of an id."""
    arcs = Arcs(*map(np.asarray, arcs))  # of JAX's own, each number would be a program
    ends, seen = arcs.ends, arcs.seen
    slots = [
        k
        for k in np.flatnonzero(seen > 0)
        if ends[k, 0] in index and (ends[k, 1] in index or ends[k, 1] < 0)
    ]
    pairs = np.array([[index.get(int(i), -1) for i in ends[k]] for k in slots], int).reshape(-1, 2)
    whole = arcs.line.astype(float)
    first, last = whole[:, 0].copy(), whole[:, -1].copy()
    first[slots] = xy[pairs[:, 0]]
    last[slots] += np.where(pairs[:, 1:] < 0, first[slots] - whole[slots, 0], 0.0)
    last[slots] = np.where(pairs[:, 1:] < 0, last[slots], xy[pairs[:, 1]])
    # All slots at once, so that it is compiled once.
    laid = np.asarray(_attach(*(jnp.asarray(x, float) for x in (whole, first, last))), float)
    line, laid = whole[slots], laid[slots]
    stretch = ways.size(laid) / np.maximum(ways.size(line), 1e-6)
    found = [
        Way(int(a), int(b), laid[n], float(arcs.length[k] * stretch[n]),
            float(arcs.clearance[k]), int(seen[k]))
        for n, (k, (a, b)) in enumerate(zip(slots, pairs, strict=True))
    ]  # fmt: skip
    wide = lambda way: np.max(np.linalg.norm(way.line - way.line[0], axis=1)) > TWIN
    return [way for way in found if way.a != way.b or wide(way)]


def graph(
    belief: Belief,
    arcs: Arcs,
    poses: np.ndarray,
    *,
    confirm: int,
    apart: float = 0.3,
    alike: float = 0.3,
) -> Graph:
    """The map as it stands: landmarks that count, the arcs between them, and what lies open.

    Landmarks of one place are one node. Two nodes are joined by an arc where a branch of a scan's
    diagram joins them, and where the robot drove from one to the other and branches do not lead
    the same way; the clearance of the latter is NaN, it was not measured. An arc that goes
    through a third node is two.

    Args:
        belief: The landmarks.
        arcs: Branches seen.
        poses: (T, 3) estimated poses of the scans.
        confirm: Sightings from which a landmark or a frontier counts.
        apart: Distance [m] below which two nodes are one,
        alike: if the logarithm of the ratio of their clearances is below this.
    """
    keep, index = _nodes(belief, confirm, apart, alike)
    kind, xy = np.asarray(belief.kind)[keep], np.asarray(belief.places, float)[keep]
    clearance = np.where(kind == NODE, np.asarray(belief.shape, float)[keep], 0.0)
    id = np.asarray(belief.id)[keep]
    near = np.where(kind == NODE, THROUGH * clearance, 0.0)
    parts = [part for way in _seen_ways(arcs, index, xy) for part in ways.split(way, xy, near)]
    known = ways.merge([way for way in parts if way.b >= 0], TWIN)
    known = ways.add_driven(known, ways.trail(xy, clearance, poses), clearance, TWIN)
    ends = [way for way in parts if way.b < 0 and way.seen >= confirm]
    open_ends = ways.still_open(ends, known, xy, clearance)
    known = [way if id[way.a] <= id[way.b] else ways.reverse(way) for way in known]
    return Graph(
        id=id,
        xy=xy,
        kind=kind,
        clearance=clearance,
        pairs=np.array([[way.a, way.b] for way in known], int).reshape(-1, 2),
        length=np.array([way.length for way in known], float),
        arc_clearance=np.array([way.clearance for way in known], float),
        lines=tuple(way.line for way in known),
        frontiers=tuple(way.line for way in open_ends),
        frontier_of=np.array([way.a for way in open_ends], int),
    )
