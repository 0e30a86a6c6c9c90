"""Global topological map: arcs merged scan by scan, and the graph built from them.

The nodes of the map are the landmarks of the filter. This module adds the arcs: which landmarks
are joined by a branch of some scan's Voronoi diagram, and by which polyline. An arc names its two
landmarks by id. Its polyline is stored in the frame of its last observation and is transported
onto the current landmark estimates (`attach`) whenever it is used, so arcs move with the map.
An arc with one landmark only is a frontier: its branch left the field of view.

Incremental, in JAX, once a scan (`add`):

    drop explored frontiers -> arcs of the scan in the map frame -> stored arcs with the same ends
    -> transport onto the new ends -> same or new -> running mean -> write to slots

On the host, when the map is asked for (`graph`):

    merge duplicate landmarks -> arcs between current landmarks -> split at nodes passed through
    -> merge parallel duplicates -> add driven arcs -> keep open frontiers
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

ROOM = 0.4  # [m] radius around the end of a frontier that must be observed to call it explored
SKIN = 0.2  # [m] assumed thickness of a wall behind the point that a beam hit
SAME_END = 1.0  # [m] two frontiers of one node with ends closer than this are the same
CHORD = 0.3  # [m] a chord shorter than this has no reliable direction
AROUND = 64  # frontiers whose surroundings are checked in one scan at most, the nearest ones
TWINS = 8  # stored arcs with the same ends that one arc of a scan is compared with at most
THROUGH = 0.5  # an arc passes through a node if it is closer than this fraction of its clearance


class Arcs(NamedTuple):
    """Arcs and frontiers of the map, in A slots of fixed size.

    Attributes:
        ends: (A, 2) int32 landmark ids, the smaller first; the second is -1 at a frontier.
        line: (A, K, 2) [m] running mean of the observed polylines, in the map frame as it was
            estimated at the last observation.
        length: (A,) [m] running mean of the observed lengths.
        clearance: (A,) [m] smallest observed distance to an obstacle along the arc.
        seen: (A,) int32 number of observations; 0 marks a free slot.
    """

    ends: Array
    line: Array
    length: Array
    clearance: Array
    seen: Array


class Graph(NamedTuple):
    """Topological map as a graph: NumPy arrays without padding, map frame.

    Attributes:
        id: (N,) int landmark ids of the nodes.
        xy: (N, 2) [m] positions of the nodes.
        kind: (N,) int `NODE` or `CORNER`; arcs join nodes of kind `NODE` only.
        clearance: (N,) [m] distance to the nearest obstacle, 0 for a corner.
        pairs: (A, 2) int indices of the two ends of each arc; (i, i) is a loop, and two arcs may
            have the same pair.
        length: (A,) [m] length of each arc.
        arc_clearance: (A,) [m] smallest distance to an obstacle along each arc; NaN for an arc
            that was driven but not observed.
        lines: A polylines (n >= 2, 2) [m], from the first end of the arc to the second.
        frontiers: F polylines (n >= 2, 2) [m], from a node to where the field of view ended.
        frontier_of: (F,) int index of that node.
    """

    id: np.ndarray
    xy: np.ndarray
    kind: np.ndarray
    clearance: np.ndarray
    pairs: np.ndarray
    length: np.ndarray
    arc_clearance: np.ndarray
    lines: tuple[np.ndarray, ...]
    frontiers: tuple[np.ndarray, ...] = ()
    frontier_of: np.ndarray = np.zeros(0, int)


class _ScanArcs(NamedTuple):
    """Arcs and frontiers observed in one scan, padded to P, map frame.

    Attributes:
        ends: (P, 2) int32 landmark ids, the smaller first; the second is -1 at a frontier.
        line: (P, K, 2) [m].
        length: (P,) [m].
        clearance: (P,) [m].
        frontier: (P,) bool.
        valid: (P,) bool, False marks what must not be merged into the map.
    """

    ends: Array
    line: Array
    length: Array
    clearance: Array
    frontier: Array
    valid: Array


class _Candidates(NamedTuple):
    """Stored arcs that have the same ends as each arc of a scan, padded to C = `TWINS`.

    Attributes:
        slot: (P, C) int32 slots of the stored arcs.
        line: (P, C, K, 2) [m] their polylines, transported onto the ends in the scan.
        distance: (P, C) [m] between the two polylines, `inf` where they are different arcs.
    """

    slot: Array
    line: Array
    distance: Array


class _Match(NamedTuple):
    """Stored arc that each arc of a scan is an observation of.

    Attributes:
        known: (P,) bool, False for an arc that is not in the map yet.
        slot: (P,) int32 slot of the stored arc; meaningless where not `known`.
        line: (P, K, 2) [m] its polyline, transported onto the ends in the scan.
        distance: (P,) [m] between the two polylines.
    """

    known: Array
    slot: Array
    line: Array
    distance: Array


def empty(*, arcs: int) -> Arcs:
    """Map without arcs, with a capacity of `arcs` slots."""
    return Arcs(
        ends=jnp.full((arcs, 2), -1, jnp.int32),
        line=jnp.zeros((arcs, LINE, 2)),
        length=jnp.zeros(arcs),
        clearance=jnp.zeros(arcs),
        seen=jnp.zeros(arcs, jnp.int32),
    )


def grown(arcs: Arcs, size: int) -> Arcs:
    """The same arcs with a capacity of `size` slots, not fewer than before."""
    return jax.tree.map(lambda old, new: new.at[: len(old)].set(old), arcs, empty(arcs=size))


def attach(line: Array, first: Array, last: Array) -> Array:
    """Transport a polyline onto new end points: rotate it with its chord, then close the gap.

    With points p_1..p_K, chords old = p_K - p_1 and new = last - first, and R the rotation from the
    direction of old to that of new,

        q_k = first + R (p_k - p_1) + s_k (new - R old)        s_k = (k - 1) / (K - 1)

    so that q_1 = first and q_K = last. The shape is kept; a change of the chord's length is spread
    evenly over the points. R is the identity if a chord is shorter than `CHORD`, as in a loop.

           stored              rotated with its chord        gap closed

                                          x last                o last
             .--.                       o                     .'
           .'    '.                  .-'                   .-'
          o        o                /                     /
         p_1      p_K        first o               first o

    Args:
        line: (..., K, 2) [m] points at equal distances.
        first: (..., 2) [m] new first point.
        last: (..., 2) [m] new last point.

    Returns:
        (..., K, 2) [m].
    """
    old, new = line[..., -1, :] - line[..., 0, :], last - first
    chords = jnp.stack([old, new], axis=-2)
    has_direction = jnp.min(jnp.linalg.norm(chords, axis=-1), axis=-1) > CHORD
    x, y = chords[..., 0], chords[..., 1]
    dot = jnp.where(has_direction, x[..., 0] * x[..., 1] + y[..., 0] * y[..., 1], 1.0)
    cross = jnp.where(has_direction, x[..., 0] * y[..., 1] - y[..., 0] * x[..., 1], 0.0)
    norm = jnp.hypot(dot, cross)
    cosine, sine = (dot / norm)[..., None], (cross / norm)[..., None]
    centred = line - line[..., :1, :]
    rotated = jnp.stack(
        [
            cosine * centred[..., 0] - sine * centred[..., 1],
            sine * centred[..., 0] + cosine * centred[..., 1],
        ],
        axis=-1,
    )
    residual = (new - rotated[..., -1, :])[..., None, :]
    fraction = jnp.linspace(0.0, 1.0, line.shape[-2], dtype=line.dtype)[:, None]
    fraction = fraction.reshape((1,) * (line.ndim - 2) + fraction.shape)
    return first[..., None, :] + rotated + fraction * residual


_attach = programs.jit(attach)


def add(arcs: Arcs, ids: Array, pose: Array, links: Links, scan: Scan, lidar: Lidar) -> Arcs:
    """Merge the arcs observed in one scan into the map.

    An observed arc is a known one if some stored arc has the same ends and, transported onto the
    end points of the observed one, nearly the same polyline. This test does not depend on how far
    the estimate has drifted since, as both polylines have the same end points:

           .-~~-.   observed            stored, transported: largest distance of corresponding
      a  o'------'o  b                  points < `TWIN`: the same arc, take the running mean

           .-~~-.   observed
      a  o        o  b                  the robot passed an obstacle on the other side:
           '-__-'   stored              a second arc between a and b

    Frontiers are compared by their ends alone. The longest polyline of a frontier is kept, and a
    frontier is dropped once the surroundings of its end have been observed.

    Args:
        arcs: The map so far, A slots.
        ids: (M,) int32 landmark id of each feature of the scan, -1 for none.
        pose: (3,) [m, m, rad] estimated pose of the scan, map frame.
        links: Branches of the scan's Voronoi diagram, P, robot frame.
        scan: The scan.
        lidar: The scanner.

    Returns:
        The map with this scan. New arcs beyond its capacity are dropped.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    _check(ids, pose, links, scan, lidar)
    arcs = _clear_slots(arcs, _explored_frontiers(arcs, pose, scan, lidar))
    observed = _arcs_of_scan(ids, pose, links, arcs.line.dtype)
    match = _best_candidate(_candidates(arcs, observed))
    observed = observed._replace(valid=observed.valid & ~_outdone(match, observed.valid))
    slot = _slots(arcs, observed, match)
    updated = _running_mean(arcs, observed, match, slot)
    return jax.tree.map(
        lambda old, new: old.at[slot].set(new.astype(old.dtype), mode="drop"), arcs, updated
    )


def _check(ids: Array, pose: Array, links: Links, scan: Scan, lidar: Lidar) -> None:
    """Raise ValueError if shapes or types do not fit."""
    if ids.ndim != 1 or not jnp.issubdtype(ids.dtype, jnp.integer):
        raise ValueError(f"ids is {ids.dtype} {ids.shape}, not integers (M,)")
    count = links.valid.shape[0]
    for name, array, shape in (
        ("pose", pose, (3,)),
        ("links.pair", links.pair, (count, 2)),
        ("links.line", links.line, (count, LINE, 2)),
        ("scan.ranges", scan.ranges, (lidar.beams,)),
    ):
        if array.shape != shape:
            raise ValueError(f"{name} is {array.shape}, not {shape}")


def _explored_frontiers(arcs: Arcs, pose: Array, scan: Scan, lidar: Lidar) -> Array:
    """Slots (AROUND,) int32 of the frontiers that a scan has explored; A for none.

    The end E of a frontier is explored if E and eight points on a circle of radius `ROOM` around
    it are observed: free (before the ends of the two neighbouring beams) or wall (up to `SKIN`
    behind a hit).

         node o--------- E          .  .       all eight points observed: nothing
                                 .  E   .      unknown is left to explore here
                                   .  .

    Few ends are in view, so the circle is computed for the `AROUND` nearest of them only.
    """
    capacity = arcs.seen.size
    depth = scan.ranges + jnp.where(scan.hit, SKIN, 0.0).astype(scan.ranges.dtype)
    end = to_robot(pose, arcs.line[:, -1])
    in_view = before_ends(end, depth, lidar) & (arcs.ends[:, 1] < 0) & (arcs.seen > 0)
    squared_distance = jnp.where(in_view, jnp.sum(end**2, axis=1), jnp.inf)
    score, slot = lax.top_k(-squared_distance, min(AROUND, capacity))
    circle = ROOM * unit(jnp.linspace(-jnp.pi, jnp.pi, 8, endpoint=False, dtype=pose.dtype))
    circle = to_robot(pose, circle[None] + arcs.line[slot, -1:])  # (AROUND, 8, 2)
    explored = (score > -jnp.inf) & jnp.all(before_ends(circle, depth, lidar), axis=1)
    return jnp.where(explored, slot, capacity).astype(jnp.int32)


def _clear_slots(arcs: Arcs, slot: Array) -> Arcs:
    """The map without the arcs in some slots; A for none."""
    return arcs._replace(
        ends=arcs.ends.at[slot].set(jnp.int32(-1), mode="drop"),
        seen=arcs.seen.at[slot].set(jnp.int32(0), mode="drop"),
    )


def _arcs_of_scan(ids: Array, pose: Array, links: Links, dtype: jnp.dtype) -> _ScanArcs:
    """Branches of a scan as arcs between landmarks in the map frame, the smaller id first.

    Valid are those whose ends are two different landmarks (one, at a frontier), whose polyline is
    finite, and which do not repeat an earlier one of the same scan.
    """
    frontier = links.pair[:, 1] < 0
    ends = jnp.where(links.pair < 0, -1, ids[links.pair])
    line = to_world(pose, links.line).astype(dtype)
    swap = ~frontier & (ends[:, 0] > ends[:, 1])
    ends = jnp.where(swap[:, None], ends[:, ::-1], ends)
    line = jnp.where(swap[:, None, None], line[:, ::-1], line)
    valid = links.valid & (ends[:, 0] >= 0) & (frontier | (ends[:, 1] >= 0))
    valid &= (ends[:, 0] != ends[:, 1]) & jnp.all(jnp.isfinite(line), axis=(1, 2))
    valid &= ~repeated(ends, line, valid)
    return _ScanArcs(ends, line, links.length, links.clearance, frontier, valid)


def _candidates(arcs: Arcs, observed: _ScanArcs) -> _Candidates:
    """Stored arcs with the same ends, transported onto each observed arc, and how far they are off.

    A stored frontier has one landmark only: it is translated to start there and keeps its end. The
    distance between the ends of two frontiers is scaled, so that `TWIN` is the gate for both kinds.
    """
    line, frontier = observed.line, observed.frontier
    same_ends = (observed.ends[:, :1] == arcs.ends[None, :, 0]) & (
        observed.ends[:, 1:] == arcs.ends[None, :, 1]
    )
    same_ends, slot = lax.top_k(same_ends.astype(line.dtype), min(TWINS, arcs.seen.size))
    stored = arcs.line[slot]  # (P, C, K, 2)
    first = jnp.broadcast_to(line[:, None, 0], (*slot.shape, 2))
    last = jnp.where(
        frontier[:, None, None],
        first + stored[:, :, -1] - stored[:, :, 0],
        jnp.broadcast_to(line[:, None, -1], first.shape),
    )
    transported = attach(stored, first, last)
    distance = jnp.where(
        frontier[:, None],
        jnp.linalg.norm(transported[:, :, -1] - line[:, None, -1], axis=-1) * (TWIN / SAME_END),
        gap(transported, line[:, None]),
    )
    same_arc = (same_ends > 0.0) & (distance < TWIN)
    return _Candidates(slot, transported, jnp.where(same_arc, distance, jnp.inf))


def _best_candidate(candidates: _Candidates) -> _Match:
    """The nearest of the candidates of each observed arc."""
    nearest = jnp.argmin(candidates.distance, axis=1)[:, None]
    distance = jnp.min(candidates.distance, axis=1)
    return _Match(
        known=distance < jnp.inf,
        slot=jnp.take_along_axis(candidates.slot, nearest, axis=1)[:, 0].astype(jnp.int32),
        line=jnp.take_along_axis(candidates.line, nearest[:, :, None, None], axis=1)[:, 0],
        distance=distance,
    )


def _outdone(match: _Match, valid: Array) -> Array:
    """Observed arcs (P,) bool whose stored arc is matched by a nearer one of the same scan too."""
    same_slot = match.slot[:, None] == match.slot[None]
    rival = same_slot & (match.known & valid)[None] & match.known[:, None]
    earlier = jnp.tril(jnp.ones(rival.shape, bool), -1)
    this, other = match.distance[:, None], match.distance[None]
    return jnp.any(rival & ((other < this) | ((other == this) & earlier)), axis=1)


def _slots(arcs: Arcs, observed: _ScanArcs, match: _Match) -> Array:
    """Slot (P,) int32 of each observed arc: that of its match, or a free one; A for none."""
    free = claim_slots(jnp.where(arcs.seen == 0, 0.0, jnp.inf), observed.valid & ~match.known)
    return jnp.where(observed.valid, jnp.where(match.known, match.slot, free), arcs.seen.size)


def _running_mean(arcs: Arcs, observed: _ScanArcs, match: _Match, slot: Array) -> Arcs:
    """New content (P, ...) of the slots that the observed arcs are written to.

    Mean of n + 1 observations from the mean of n: m + (x - m) / (n + 1). A new arc has weight 1.
    A known frontier is replaced by a longer one, else kept.
    """
    known, line = match.known, observed.line
    stored = jnp.minimum(slot, arcs.seen.size - 1)
    weight = jnp.where(known, 1.0 / (arcs.seen[stored] + 1).astype(line.dtype), 1.0)
    longer = (observed.length > arcs.length[stored]).astype(line.dtype)
    weight = jnp.where(observed.frontier & known, longer, weight)
    old_line = jnp.where(known[:, None, None], match.line, line)
    old_length = arcs.length[stored]
    new_length = jnp.where(observed.valid, observed.length, 0.0)
    old_clearance = jnp.where(known, arcs.clearance[stored], jnp.inf)
    return Arcs(
        ends=observed.ends,
        line=old_line + weight[:, None, None] * (line - old_line),
        length=old_length + weight * (new_length - old_length),
        clearance=jnp.minimum(old_clearance, observed.clearance),
        seen=jnp.where(known, arcs.seen[stored], 0) + 1,
    )


def graph(
    belief: Belief,
    arcs: Arcs,
    poses: np.ndarray,
    *,
    confirm: int,
    apart: float = 0.3,
    alike: float = 0.3,
) -> Graph:
    """Topological map: confirmed landmarks, the arcs between them, and the open frontiers.

    Duplicate landmarks are merged into one node. Two nodes are joined by an arc where a branch of
    some scan's Voronoi diagram joins them, and where the robot drove from one to the other along
    no observed arc (clearance NaN, as it was not measured). An arc that passes through a third
    node is split there. Runs on the host.

    Args:
        belief: The landmarks, L slots.
        arcs: The observed arcs.
        poses: (T, 3) [m, m, rad] estimated poses of the scans, map frame.
        confirm: Number of observations that confirms a landmark or a frontier.
        apart: [m] two junctions closer than this are duplicates if their clearances are alike.
        alike: Two clearances are alike if the difference of their logarithms is below this.
    """
    slots, node_of = _graph_nodes(belief, confirm, apart, alike)
    ids, kind = np.asarray(belief.id)[slots], np.asarray(belief.kind)[slots]
    xy = np.asarray(belief.places, float)[slots]
    clearance = np.where(kind == NODE, np.asarray(belief.shape, float)[slots], 0.0)
    radius = np.where(kind == NODE, THROUGH * clearance, 0.0)
    observed = [
        piece for arc in _arcs_between(arcs, node_of, xy) for piece in ways.split(arc, xy, radius)
    ]
    known = ways.merge([arc for arc in observed if arc.b >= 0], TWIN)
    known = ways.add_driven(known, ways.trail(xy, clearance, poses), clearance, TWIN)
    frontiers = [arc for arc in observed if arc.b < 0 and arc.seen >= confirm]
    frontiers = ways.still_open(frontiers, known, xy, clearance)
    known = [arc if ids[arc.a] <= ids[arc.b] else ways.reverse(arc) for arc in known]
    return Graph(
        id=ids,
        xy=xy,
        kind=kind,
        clearance=clearance,
        pairs=np.array([[arc.a, arc.b] for arc in known], int).reshape(-1, 2),
        length=np.array([arc.length for arc in known], float),
        arc_clearance=np.array([arc.clearance for arc in known], float),
        lines=tuple(arc.line for arc in known),
        frontiers=tuple(arc.line for arc in frontiers),
        frontier_of=np.array([arc.a for arc in frontiers], int),
    )


def _graph_nodes(
    belief: Belief, confirm: int, apart: float, alike: float
) -> tuple[np.ndarray, dict[int, int]]:
    """Landmarks that become nodes of the graph, duplicates merged.

    Two junctions at most `apart` [m] from each other, with clearances that are `alike`, are
    duplicates. Each cluster is represented by its confirmed member of the smallest id, greedily:
    the smallest id takes all its unassigned neighbours, then the next unassigned id does. A
    landmark that is not confirmed joins a cluster but founds none.

    Returns:
        Slots (N,) of the representatives and of the confirmed corners, in order, and the index
        0..N-1 of the node that each junction id stands for, duplicates included.
    """
    seen, kind, ids = (np.asarray(field) for field in (belief.seen, belief.kind, belief.id))
    xy, log_clearance = np.asarray(belief.places, float), np.log(np.maximum(belief.shape, 1e-3))
    junctions = np.flatnonzero((seen > 0) & (kind == NODE))
    confirmed = seen[junctions] >= confirm
    near = np.linalg.norm(xy[junctions, None] - xy[None, junctions], axis=2) < apart
    near &= np.abs(log_clearance[junctions, None] - log_clearance[None, junctions]) < alike
    representative = np.full(len(junctions), -1)
    for k in sorted(np.flatnonzero(confirmed), key=lambda k: ids[junctions[k]]):
        if representative[k] < 0:
            representative[near[k] & (representative < 0)] = k
    slots = np.concatenate(
        [
            junctions[np.unique(representative[representative >= 0])],
            np.flatnonzero((seen >= confirm) & (kind == CORNER)),
        ]
    )
    slots = np.sort(slots)
    index = {int(slot): n for n, slot in enumerate(slots)}
    node_of = {
        int(ids[slot]): index[int(junctions[k])]
        for slot, k in zip(junctions, representative, strict=True)
        if k >= 0
    }
    return slots, node_of


def _arcs_between(arcs: Arcs, node_of: dict[int, int], xy: np.ndarray) -> list[Way]:
    """Stored arcs and frontiers, transported onto the nodes of the graph at `xy` (N, 2) [m].

    Left out are arcs of landmarks that are no nodes, and arcs that have collapsed: their two ends
    are one node by now and the polyline stays within `TWIN` of it.
    """
    arcs = Arcs(*map(np.asarray, arcs))  # indexing a JAX array would compile a program each time
    slots = [
        slot
        for slot in np.flatnonzero(arcs.seen > 0)
        if arcs.ends[slot, 0] in node_of
        and (arcs.ends[slot, 1] in node_of or arcs.ends[slot, 1] < 0)
    ]
    pairs = np.array(
        [[node_of.get(int(landmark), -1) for landmark in arcs.ends[slot]] for slot in slots], int
    ).reshape(-1, 2)
    frontier = pairs[:, 1:] < 0
    stored = arcs.line.astype(float)
    first, last = stored[:, 0].copy(), stored[:, -1].copy()
    first[slots] = xy[pairs[:, 0]]
    last[slots] += np.where(frontier, first[slots] - stored[slots, 0], 0.0)
    last[slots] = np.where(frontier, last[slots], xy[pairs[:, 1]])
    # All slots, used or not, so that the shape never changes and one program is compiled.
    transported = _attach(*(jnp.asarray(points, float) for points in (stored, first, last)))
    lines = np.asarray(transported, float)[slots]
    scale = ways.size(lines) / np.maximum(ways.size(stored[slots]), 1e-6)
    found = [
        Way(
            int(a),
            int(b),
            lines[n],
            float(arcs.length[slot] * scale[n]),
            float(arcs.clearance[slot]),
            int(arcs.seen[slot]),
        )
        for n, (slot, (a, b)) in enumerate(zip(slots, pairs, strict=True))
    ]
    return [
        arc
        for arc in found
        if arc.a != arc.b or np.max(np.linalg.norm(arc.line - arc.line[0], axis=1)) > TWIN
    ]
