"""Arcs of the topological map in fixed slots, merged scan by scan in JAX."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from numpy.typing import ArrayLike

from jaxslam.core.arguments import as_float
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import inverse_transform, transform, unit_vector
from jaxslam.core.types import Array, check_array
from jaxslam.filtering.map_management import claim_slots
from jaxslam.frontend.arc_tracing import POLYLINE_POINTS
from jaxslam.frontend.lidar import in_free_view
from jaxslam.frontend.local_graph import SAME_ARC_DISTANCE, LocalArcs, polyline_gap, repeats_earlier
from jaxslam.mapping.polyline_transport import attach_polyline

# [m] radius around the end of a frontier that must be observed to call it explored
FRONTIER_RADIUS = 0.4
WALL_SKIN = 0.2  # [m] assumed thickness of a wall behind the point that a beam hit
# [m] two frontiers of one node with ends closer than this are the same
SAME_FRONTIER_DISTANCE = 1.0
# Largest number of frontiers whose surroundings are checked in one scan, the nearest ones.
MAX_FRONTIERS_CHECKED = 64
# Largest number of stored arcs with the same ends that one arc of a scan is compared with.
MAX_PARALLEL_ARCS = 8


class ArcTable(NamedTuple):
    """Arcs and frontiers of the map, in A slots of fixed size.

    Attributes:
        ends: (A, 2) int32 landmark ids, the smaller first; the second is -1 at a frontier.
        polyline: (A, K, 2) [m] running mean of the observed polylines, in the map frame as it was
            estimated at the last observation.
        length: (A,) [m] running mean of the observed lengths.
        clearance: (A,) [m] smallest observed distance to an obstacle along the arc.
        num_seen: (A,) int32 number of observations; 0 marks a free slot.
    """

    ends: Array
    polyline: Array
    length: Array
    clearance: Array
    num_seen: Array


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
    """Stored arcs that have the same ends as each arc of a scan, padded to C = `MAX_PARALLEL_ARCS`.

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


def empty_arcs(*, capacity: int) -> ArcTable:
    """Map without arcs.

    Args:
        capacity: A, number of slots.

    Raises:
        ValueError: The capacity is not at least 1.
    """
    if capacity < 1:
        raise ValueError(f"capacity is {capacity}, not a number of slots >= 1")
    return ArcTable(
        ends=jnp.full((capacity, 2), -1, jnp.int32),
        polyline=jnp.zeros((capacity, POLYLINE_POINTS, 2)),
        length=jnp.zeros(capacity),
        clearance=jnp.zeros(capacity),
        num_seen=jnp.zeros(capacity, jnp.int32),
    )


def grow_arcs(arcs: ArcTable, capacity: int) -> ArcTable:
    """The same arcs with a capacity of `capacity` slots, not fewer than before."""
    return jax.tree.map(
        lambda old, new: new.at[: len(old)].set(old), arcs, empty_arcs(capacity=capacity)
    )


def add_scan_arcs(
    lidar: Lidar, arcs: ArcTable, ids: ArrayLike, pose: ArrayLike, local_arcs: LocalArcs, scan: Scan
) -> ArcTable:
    """Merge the arcs observed in one scan into the map.

    An observed arc is a known one if some stored arc has the same ends and, transported onto the
    end points of the observed one, nearly the same polyline. This test does not depend on how far
    the estimate has drifted since, as both polylines have the same end points:

           .-~~-.   observed            stored, transported: largest distance of corresponding
      a  o'------'o  b                  points < `SAME_ARC_DISTANCE`: the same arc, so take the
                                        running mean

           .-~~-.   observed
      a  o        o  b                  the robot passed an obstacle on the other side:
           '-__-'   stored              a second arc between a and b

    Frontiers are compared by their ends alone. The longest polyline of a frontier is kept, and a
    frontier is dropped once the surroundings of its end have been observed.

    Args:
        lidar: The scanner.
        arcs: The map so far, A slots.
        ids: (M,) int landmark id of each feature of the scan, -1 for none.
        pose: (3,) [m, m, rad] estimated pose of the scan, map frame.
        local_arcs: Branches of the scan's Voronoi diagram, P, robot frame.
        scan: The scan.

    Returns:
        The map with this scan. New arcs beyond its capacity are dropped.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    arcs, ids, pose, local_arcs, scan = _checked(lidar, arcs, ids, pose, local_arcs, scan)
    arcs = _clear_slots(arcs, _explored_frontiers(arcs, pose, scan, lidar))
    observed = _arcs_of_scan(ids, pose, local_arcs, arcs.polyline.dtype)
    match = _best_candidate(_candidates(arcs, observed))
    observed = observed._replace(valid=observed.valid & ~_outdone(match, observed.valid))
    slot = _slots(arcs, observed, match)
    updated = _running_mean(arcs, observed, match, slot)
    return jax.tree.map(
        lambda old, new: old.at[slot].set(new.astype(old.dtype), mode="drop"), arcs, updated
    )


def _checked(
    lidar: Lidar, arcs: ArcTable, ids: ArrayLike, pose: ArrayLike, local_arcs: LocalArcs, scan: Scan
) -> tuple[ArcTable, Array, Array, LocalArcs, Scan]:
    """The arguments of `add_scan_arcs` as JAX arrays; ValueError if shapes or types do not fit."""
    for name, record, kind in (
        ("lidar", lidar, Lidar),
        ("arcs", arcs, ArcTable),
        ("local_arcs", local_arcs, LocalArcs),
        ("scan", scan, Scan),
    ):
        if not isinstance(record, kind):
            raise ValueError(f"{name} is of type {type(record).__name__}, not {kind.__name__}")
    arcs, ids = jax.tree.map(jnp.asarray, arcs), jnp.asarray(ids)
    pair, valid, hit = map(jnp.asarray, (local_arcs.pair, local_arcs.valid, scan.hit))
    count, beams = valid.size, lidar.num_beams
    check_array("arcs.polyline", arcs.polyline, ("A", POLYLINE_POINTS, 2), jnp.floating)
    check_array("ids", ids, ("M",), jnp.integer)
    check_array("local_arcs.valid", valid, (count,), jnp.bool_)
    check_array("local_arcs.pair", pair, (count, 2), jnp.integer)
    check_array("scan.hit", hit, (beams,), jnp.bool_)
    polyline_shape = (count, POLYLINE_POINTS, 2)
    local_arcs = LocalArcs(
        pair=pair.astype(jnp.int32),
        polyline=as_float("local_arcs.polyline", local_arcs.polyline, polyline_shape),
        length=as_float("local_arcs.length", local_arcs.length, (count,)),
        clearance=as_float("local_arcs.clearance", local_arcs.clearance, (count,)),
        valid=valid,
    )
    pose = as_float("pose", pose, (3,))
    scan = Scan(as_float("scan.ranges", scan.ranges, (beams,)), hit)
    return arcs, ids.astype(jnp.int32), pose, local_arcs, scan


def _explored_frontiers(arcs: ArcTable, pose: Array, scan: Scan, lidar: Lidar) -> Array:
    """Slots (F,) int32 of the frontiers that a scan has explored; A for none.

    The end E of a frontier is explored if E and eight points on a circle of radius
    `FRONTIER_RADIUS` around it are observed: free (before the ends of the two neighbouring beams)
    or wall (up to `WALL_SKIN` behind a hit).

         node o--------- E          .  .       all eight points observed: nothing
                                 .  E   .      unknown is left to explore here
                                   .  .

    Few ends are in view, so the circle is computed for the nearest of them only, F =
    `MAX_FRONTIERS_CHECKED`.
    """
    capacity = arcs.num_seen.size
    depth = scan.ranges + jnp.where(scan.hit, WALL_SKIN, 0.0).astype(scan.ranges.dtype)
    end = inverse_transform(pose, arcs.polyline[:, -1])
    in_view = in_free_view(lidar, end, depth) & (arcs.ends[:, 1] < 0) & (arcs.num_seen > 0)
    squared_distance = jnp.where(in_view, jnp.sum(end**2, axis=1), jnp.inf)
    score, slot = lax.top_k(-squared_distance, min(MAX_FRONTIERS_CHECKED, capacity))
    circle = FRONTIER_RADIUS * unit_vector(
        jnp.linspace(-jnp.pi, jnp.pi, 8, endpoint=False, dtype=pose.dtype)
    )
    circle = inverse_transform(pose, circle[None] + arcs.polyline[slot, -1:])  # (F, 8, 2)
    explored = (score > -jnp.inf) & jnp.all(in_free_view(lidar, circle, depth), axis=1)
    return jnp.where(explored, slot, capacity).astype(jnp.int32)


def _clear_slots(arcs: ArcTable, slot: Array) -> ArcTable:
    """The map without the arcs in some slots; A for none."""
    return arcs._replace(
        ends=arcs.ends.at[slot].set(jnp.int32(-1), mode="drop"),
        num_seen=arcs.num_seen.at[slot].set(jnp.int32(0), mode="drop"),
    )


def _arcs_of_scan(ids: Array, pose: Array, local_arcs: LocalArcs, dtype: jnp.dtype) -> _ScanArcs:
    """Branches of a scan as arcs between landmarks in the map frame, the smaller id first.

    Valid are those whose ends are two different landmarks (one, at a frontier), whose polyline is
    finite, and which do not repeat an earlier one of the same scan.
    """
    frontier = local_arcs.pair[:, 1] < 0
    ends = jnp.where(local_arcs.pair < 0, -1, ids[local_arcs.pair])
    line = transform(pose, local_arcs.polyline).astype(dtype)
    swap = ~frontier & (ends[:, 0] > ends[:, 1])
    ends = jnp.where(swap[:, None], ends[:, ::-1], ends)
    line = jnp.where(swap[:, None, None], line[:, ::-1], line)
    valid = local_arcs.valid & (ends[:, 0] >= 0) & (frontier | (ends[:, 1] >= 0))
    valid &= (ends[:, 0] != ends[:, 1]) & jnp.all(jnp.isfinite(line), axis=(1, 2))
    valid &= ~repeats_earlier(ends, line, valid)
    return _ScanArcs(ends, line, local_arcs.length, local_arcs.clearance, frontier, valid)


def _candidates(arcs: ArcTable, observed: _ScanArcs) -> _Candidates:
    """Stored arcs with the same ends, transported onto each observed arc, and how far they are off.

    A stored frontier has one landmark only: it is translated to start there and keeps its end. The
    distance between the ends of two frontiers is scaled, so that `SAME_ARC_DISTANCE` is the gate
    for both kinds.
    """
    line, frontier = observed.line, observed.frontier
    same_ends = (observed.ends[:, :1] == arcs.ends[None, :, 0]) & (
        observed.ends[:, 1:] == arcs.ends[None, :, 1]
    )
    same_ends, slot = lax.top_k(
        same_ends.astype(line.dtype), min(MAX_PARALLEL_ARCS, arcs.num_seen.size)
    )
    stored = arcs.polyline[slot]  # (P, C, K, 2)
    first = jnp.broadcast_to(line[:, None, 0], (*slot.shape, 2))
    last = jnp.where(
        frontier[:, None, None],
        first + stored[:, :, -1] - stored[:, :, 0],
        jnp.broadcast_to(line[:, None, -1], first.shape),
    )
    transported = attach_polyline(stored, first, last)
    distance = jnp.where(
        frontier[:, None],
        jnp.linalg.norm(transported[:, :, -1] - line[:, None, -1], axis=-1)
        * (SAME_ARC_DISTANCE / SAME_FRONTIER_DISTANCE),
        polyline_gap(transported, line[:, None]),
    )
    same_arc = (same_ends > 0.0) & (distance < SAME_ARC_DISTANCE)
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


def _slots(arcs: ArcTable, observed: _ScanArcs, match: _Match) -> Array:
    """Slot (P,) int32 of each observed arc: that of its match, or a free one; A for none."""
    free = claim_slots(jnp.where(arcs.num_seen == 0, 0.0, jnp.inf), observed.valid & ~match.known)
    return jnp.where(observed.valid, jnp.where(match.known, match.slot, free), arcs.num_seen.size)


def _running_mean(arcs: ArcTable, observed: _ScanArcs, match: _Match, slot: Array) -> ArcTable:
    """New content (P, ...) of the slots that the observed arcs are written to.

    Mean of n + 1 observations from the mean of n: m + (x - m) / (n + 1). A new arc has weight 1.
    A known frontier is replaced by a longer one, else kept.
    """
    known, line = match.known, observed.line
    stored = jnp.minimum(slot, arcs.num_seen.size - 1)
    weight = jnp.where(known, 1.0 / (arcs.num_seen[stored] + 1).astype(line.dtype), 1.0)
    longer = (observed.length > arcs.length[stored]).astype(line.dtype)
    weight = jnp.where(observed.frontier & known, longer, weight)
    old_line = jnp.where(known[:, None, None], match.line, line)
    old_length = arcs.length[stored]
    new_length = jnp.where(observed.valid, observed.length, 0.0)
    old_clearance = jnp.where(known, arcs.clearance[stored], jnp.inf)
    return ArcTable(
        ends=observed.ends,
        polyline=old_line + weight[:, None, None] * (line - old_line),
        length=old_length + weight * (new_length - old_length),
        clearance=jnp.minimum(old_clearance, observed.clearance),
        num_seen=jnp.where(known, arcs.num_seen[stored], 0) + 1,
    )
