"""Global topological map: arcs merged scan by scan, and the graph built from them.

The nodes of the map are the landmarks of the filter. This module adds the arcs: which landmarks
are joined by a branch of some scan's Voronoi diagram, and by which polyline. An arc names its two
landmarks by id. Its polyline is stored in the frame of its last observation and is transported
onto the current landmark estimates (`attach_polyline`) whenever it is used, so arcs move with the
map.
An arc with one landmark only is a frontier: its branch left the field of view.

Incremental, in JAX, once a scan (`add_scan_arcs`):

    drop explored frontiers -> arcs of the scan in the map frame -> stored arcs with the same ends
    -> transport onto the new ends -> same or new -> running mean -> write to slots

On the host, when the map is asked for (`build_map`):

    merge duplicate landmarks -> arcs between current landmarks -> split at nodes passed through
    -> merge parallel duplicates -> add driven arcs -> keep open frontiers
"""

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core import polylines, trace_cache
from jaxslam.core.batching import on_device
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.types import CORNER, JUNCTION, as_float64
from jaxslam.filtering.belief import Belief
from jaxslam.frontend.local_graph import SAME_ARC_DISTANCE
from jaxslam.mapping import graph_arcs
from jaxslam.mapping.arc_table import ArcTable
from jaxslam.mapping.graph_arcs import Arc
from jaxslam.mapping.polyline_transport import attach_polyline

# An arc passes through a node if it is closer than this fraction of the node's clearance.
PASS_CLEARANCE = 0.5

_attach = trace_cache.jit(attach_polyline, compile_quickly="unoptimised")


def build_map(
    belief: Belief,
    arcs: ArcTable,
    poses: ArrayLike,
    *,
    confirm_count: int,
    min_separation: float = 0.3,
    max_log_clearance_ratio: float = 0.3,
) -> TopologicalMap:
    """Topological map: confirmed landmarks, the arcs between them, and the open frontiers.

    Duplicate landmarks are merged into one node. Two nodes are joined by an arc where a branch of
    some scan's Voronoi diagram joins them, and where the robot drove from one to the other along
    no observed arc (clearance NaN, as it was not measured). An arc that passes through a third
    node is split there. It is computed on the host.

    Args:
        belief: The landmarks, L slots.
        arcs: The observed arcs.
        poses: (T, 3) [m, m, rad] estimated poses of the scans, map frame.
        confirm_count: Number of observations that confirms a landmark or a frontier.
        min_separation: [m] two junctions closer than this are duplicates if their clearances are
            alike.
        max_log_clearance_ratio: Two clearances are alike if the difference of their logarithms is
            below this.

    Raises:
        ValueError: An argument has another type, shape or range.
    """
    if not isinstance(belief, Belief):
        raise ValueError(f"belief is of type {type(belief).__name__}, not Belief")
    if not isinstance(arcs, ArcTable):
        raise ValueError(f"arcs is of type {type(arcs).__name__}, not ArcTable")
    poses = as_float64("poses", poses, ("T", 3))
    if confirm_count < 1:
        raise ValueError(f"confirm_count is {confirm_count}, not a number of observations >= 1")
    for name, limit in (
        ("min_separation", min_separation),
        ("max_log_clearance_ratio", max_log_clearance_ratio),
    ):
        if not limit >= 0.0:
            raise ValueError(f"{name} is {limit}, not a number >= 0")
    slots, node_of = _graph_nodes(belief, confirm_count, min_separation, max_log_clearance_ratio)
    ids, kind = np.asarray(belief.id)[slots], np.asarray(belief.kind)[slots]
    xy = np.asarray(belief.mean, float)[3:].reshape(-1, 2)[slots]
    clearance = np.where(kind == JUNCTION, np.asarray(belief.descriptor, float)[slots], 0.0)
    radius = np.where(kind == JUNCTION, PASS_CLEARANCE * clearance, 0.0)
    observed = [
        piece
        for arc in _arcs_between(arcs, node_of, xy)
        for piece in graph_arcs.split_at_nodes(arc, xy, radius)
    ]
    known = graph_arcs.merge_parallel([arc for arc in observed if arc.end >= 0], SAME_ARC_DISTANCE)
    known = graph_arcs.add_driven_arcs(
        known, graph_arcs.driven_arcs(xy, clearance, poses), clearance, SAME_ARC_DISTANCE
    )
    frontiers = [arc for arc in observed if arc.end < 0 and arc.num_seen >= confirm_count]
    frontiers = graph_arcs.open_frontiers(frontiers, known, xy, clearance)
    known = [arc if ids[arc.start] <= ids[arc.end] else graph_arcs.reverse(arc) for arc in known]
    return TopologicalMap(
        id=ids,
        xy=xy,
        kind=kind,
        clearance=clearance,
        arc_ends=np.array([[arc.start, arc.end] for arc in known], int).reshape(-1, 2),
        arc_length=np.array([arc.length for arc in known], float),
        arc_clearance=np.array([arc.clearance for arc in known], float),
        arc_lines=tuple(arc.polyline for arc in known),
        frontiers=tuple(arc.polyline for arc in frontiers),
        frontier_node=np.array([arc.start for arc in frontiers], int),
    )


def _graph_nodes(
    belief: Belief, confirm_count: int, min_separation: float, max_log_ratio: float
) -> tuple[np.ndarray, dict[int, int]]:
    """Landmarks that become nodes of the graph, duplicates merged.

    Two junctions closer than `min_separation` [m] to each other, with clearances whose logarithms
    differ by less than `max_log_ratio`, are duplicates. Each cluster is represented by its
    confirmed member of the smallest id, greedily: the smallest id takes all its unassigned
    neighbours, then the next unassigned id does. A landmark that is not confirmed joins a cluster
    but founds none.

    Returns:
        Slots (N,) of the representatives and of the confirmed corners, in order, and the index
        0..N-1 of the node that each junction id stands for, duplicates included.
    """
    seen, kind, ids = (np.asarray(field) for field in (belief.num_seen, belief.kind, belief.id))
    xy = np.asarray(belief.mean, float)[3:].reshape(-1, 2)
    log_clearance = np.log(np.maximum(belief.descriptor, 1e-3))
    junctions = np.flatnonzero((seen > 0) & (kind == JUNCTION))
    confirmed = seen[junctions] >= confirm_count
    near = np.linalg.norm(xy[junctions, None] - xy[None, junctions], axis=2) < min_separation
    near &= np.abs(log_clearance[junctions, None] - log_clearance[None, junctions]) < max_log_ratio
    representative = np.full(len(junctions), -1)
    for k in sorted(np.flatnonzero(confirmed), key=lambda k: ids[junctions[k]]):
        if representative[k] < 0:
            representative[near[k] & (representative < 0)] = k
    slots = np.concatenate(
        [
            junctions[np.unique(representative[representative >= 0])],
            np.flatnonzero((seen >= confirm_count) & (kind == CORNER)),
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


def _arcs_between(arcs: ArcTable, node_of: dict[int, int], xy: np.ndarray) -> list[Arc]:
    """Stored arcs and frontiers, transported onto the nodes of the graph at `xy` (N, 2) [m].

    Left out are arcs of landmarks that are no nodes, and arcs that have collapsed: their two ends
    are one node by now and the polyline stays within `SAME_ARC_DISTANCE` of it.
    """
    # NumPy, as indexing a JAX array would compile a program each time.
    arcs = jax.tree.map(np.asarray, arcs)
    slots = [
        slot
        for slot in np.flatnonzero(arcs.num_seen > 0)
        if arcs.ends[slot, 0] in node_of
        and (arcs.ends[slot, 1] in node_of or arcs.ends[slot, 1] < 0)
    ]
    if not slots:
        return []  # and nothing is compiled
    pairs = np.array(
        [[node_of.get(int(landmark), -1) for landmark in arcs.ends[slot]] for slot in slots], int
    ).reshape(-1, 2)
    frontier = pairs[:, 1:] < 0
    stored = np.asarray(arcs.polyline, float)
    first, last = stored[:, 0].copy(), stored[:, -1].copy()
    first[slots] = xy[pairs[:, 0]]
    last[slots] += np.where(frontier, first[slots] - stored[slots, 0], 0.0)
    last[slots] = np.where(frontier, last[slots], xy[pairs[:, 1]])
    # All slots, used or not, so that the shape never changes and one program is compiled.
    transported = _attach(*on_device((stored, first, last)))
    lines = np.asarray(transported, float)[slots]
    scale = polylines.length(lines) / np.maximum(polylines.length(stored[slots]), 1e-6)
    found = [
        Arc(
            int(a),
            int(b),
            lines[n],
            float(arcs.length[slot] * scale[n]),
            float(arcs.clearance[slot]),
            int(arcs.num_seen[slot]),
        )
        for n, (slot, (a, b)) in enumerate(zip(slots, pairs, strict=True))
    ]
    return [
        arc
        for arc in found
        if arc.start != arc.end
        or np.max(np.linalg.norm(arc.polyline - arc.polyline[0], axis=1)) > SAME_ARC_DISTANCE
    ]
