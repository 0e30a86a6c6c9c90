"""From the map of earlier sessions to a new one: ids of arcs, and what a user added.

A node keeps what was added to the node of its id and kind, an arc what was added to that of the
same ends; of parallel arcs, to the nearest polyline.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from jaxslam.core.polylines import resample
from jaxslam.io.annotated_map import GRAPH_TYPES, LINES, AnnotatedMap, OldArc, OldEdge, whole
from jaxslam.io.geojson import COUNTERS, NOTHING, Arc, Node

MAX_ARC_DISTANCE = 1.0  # [m] mean, between polylines of one arc in two sessions, with equal ends
MAX_NOTED = 20  # ids in a note


class CarriedOver(NamedTuple):
    """What `geojson.write` writes.

    Attributes:
        nodes: With the user's properties.
        arcs: With their old ids and the user's properties.
        features: Features of the user.
        members: Members of the file.
        notes: What could not be kept as it was, a line each.
    """

    nodes: tuple[Node, ...]
    arcs: tuple[Arc, ...]
    features: tuple[Mapping[str, Any], ...]
    members: Mapping[str, Any]
    notes: tuple[str, ...]


class _Match(NamedTuple):
    """Old arc of a new one, and the old edges in its direction and back."""

    arc: OldArc
    edges: tuple[OldEdge | None, OldEdge | None]


def carry_over(old: AnnotatedMap, nodes: Sequence[Node], arcs: Sequence[Arc]) -> CarriedOver:
    """Give a new map the ids of arcs and what a user added in the old one.

    Ids of edges differ from those of nodes. Where a new landmark has the id of an old edge or of a
    feature of the user, that one is numbered anew, and a note says so; landmarks that are numbered
    from `old.next_id` do not.

    Args:
        old: As `annotated_map.read` gives it, of the same map frame.
        nodes: Their ids are landmark ids, the same in all sessions.
        arcs: Their ids are ignored.
    """
    node_ids = {int(node.id) for node in nodes}
    fresh_arc = count(old.next_arc)
    fresh_id = count(max(old.next_id, 1 + max(node_ids, default=-1)))
    kept_nodes, gone_nodes = _carry_nodes(old, nodes)
    matches = _match_arcs(old.arcs, arcs)
    renumbered: dict[int, int] = {}
    kept_arcs = []
    for arc, match in zip(arcs, matches, strict=True):
        there, back = (None, None) if match is None else match.edges
        edges = [_edge_id(edge, node_ids, fresh_id, renumbered) for edge in (there, back)]
        kept_arcs.append(
            arc._replace(
                id=next(fresh_arc) if match is None else match.arc.id,
                edges=(edges[0], edges[1]),
                properties=(_properties(there), _properties(back)),
            )
        )
    features, lost_ends = _carry_features(old.features, node_ids, fresh_id, renumbered)
    found = {match.arc.id for match in matches if match is not None}
    gone_arcs = [
        arc.id
        for arc in old.arcs
        if arc.id not in found and any(_is_annotated(edge.properties) for edge in arc.edges)
    ]
    half = [match.arc.id for match in matches if match is not None and None in match.edges]
    gone_half = [arc.id for arc in old.arcs if arc.id not in found and len(arc.edges) == 1]
    return CarriedOver(
        nodes=kept_nodes,
        arcs=tuple(kept_arcs),
        features=features,
        members=_members(old, next(fresh_arc), next(fresh_id), kept_nodes, kept_arcs, features),
        notes=_notes(gone_nodes, gone_arcs, half, gone_half, renumbered, lost_ends),
    )


def _carry_nodes(old: AnnotatedMap, nodes: Sequence[Node]) -> tuple[tuple[Node, ...], list[int]]:
    """New nodes with the user's properties, and the ids of annotated nodes that are gone."""
    known = {(node.id, node.kind): node.properties for node in old.nodes}
    kept = tuple(n._replace(properties=known.get((int(n.id), n.kind), NOTHING)) for n in nodes)
    present = {(int(node.id), node.kind) for node in nodes}
    gone = [
        node.id
        for node in old.nodes
        if (node.id, node.kind) not in present and _is_annotated(node.properties)
    ]
    return kept, gone


def _match_arcs(old: Sequence[OldArc], new: Sequence[Arc]) -> list[_Match | None]:
    """Old arc of each new one, none for an arc that was not there."""
    groups: dict[frozenset[int], tuple[list[OldArc], list[int]]] = defaultdict(lambda: ([], []))
    for known in old:
        groups[frozenset((known.edges[0].start, known.edges[0].end))][0].append(known)
    for index, arc in enumerate(new):
        groups[frozenset((int(arc.start), int(arc.end)))][1].append(index)
    matches: list[_Match | None] = [None] * len(new)
    for group, indices in groups.values():
        options = [[_compare(known, new[index]) for index in indices] for known in group]
        if len(group) == len(indices) == 1:
            matches[indices[0]] = options[0][0][1]
        elif group and indices:
            distance = np.array([[gap for gap, _ in row] for row in options])
            close = distance < MAX_ARC_DISTANCE
            costs = np.where(close, distance, len(group) * MAX_ARC_DISTANCE)
            for row, column in zip(*linear_sum_assignment(costs), strict=True):
                if close[row, column]:
                    matches[indices[column]] = options[row][column][1]
    return matches


def _compare(old: OldArc, new: Arc) -> tuple[float, _Match]:
    """Distance [m] of an old from a new arc with the same ends, and the match that it would be.

    Of two loops the direction in which they are nearer is taken, of other arcs that of their ends.
    """
    ends = int(new.start), int(new.end)
    first = old.edges[0]
    other = old.edges[1] if len(old.edges) == 2 else None
    options = []
    if (first.start, first.end) == ends:
        options.append((_distance(first.line, first.length, new), _Match(old, (first, other))))
    if (first.end, first.start) == ends:
        line = None if first.line is None else first.line[::-1]
        options.append((_distance(line, first.length, new), _Match(old, (other, first))))
    return min(options, key=lambda option: option[0])


def _distance(line: np.ndarray | None, length: float, new: Arc) -> float:
    """Mean distance [m] of corresponding points of two polylines, the ends moved onto each other.

    Without the old line it is the difference of the lengths, infinite without both.
    """
    if line is None:
        gap = abs(length - new.length)
        return gap if np.isfinite(gap) else np.inf
    offset = resample(np.asarray(new.points, np.float64)) - resample(line)
    offset = offset - np.linspace(offset[0], offset[-1], len(offset))
    return float(np.linalg.norm(offset, axis=1).mean())


def _edge_id(
    edge: OldEdge | None, taken: Collection[int], fresh: Iterator[int], renumbered: dict[int, int]
) -> int:
    """Id of an edge: the old one, unless there is none or a node has it."""
    if edge is None:
        return next(fresh)
    if edge.id in taken:
        renumbered[edge.id] = next(fresh)
    return renumbered.get(edge.id, edge.id)


def _properties(edge: OldEdge | None) -> Mapping[str, Any]:
    """What a user added to an edge."""
    return NOTHING if edge is None else edge.properties


def _is_annotated(properties: Mapping[str, Any]) -> bool:
    """Whether a user added something: null is what editors fill tables with."""
    return any(value is not None for value in properties.values())


def _graph_id(feature: Mapping[str, Any]) -> int | None:
    """Id of a node or edge of the user."""
    is_of_graph = (feature.get("geometry") or {}).get("type") in GRAPH_TYPES
    return whole((feature.get("properties") or {}).get("id")) if is_of_graph else None


def _carry_features(
    features: Sequence[Mapping[str, Any]],
    node_ids: set[int],
    fresh: Iterator[int],
    renumbered: dict[int, int],
) -> tuple[tuple[Mapping[str, Any], ...], list[str]]:
    """Features of the user, and the ids of those edges that end at a node that is gone.

    Features with the id of a node get another one, which is added to `renumbered`.
    """
    points: dict[int, int] = {}  # new ids of the user's own nodes
    for feature in features:
        own = _graph_id(feature)
        if own is not None:
            if own in node_ids:
                renumbered[own] = next(fresh)
            if feature["geometry"]["type"] == "Point":
                points[own] = renumbered.get(own, own)
    kept, lost = [], []
    for number, feature in enumerate(features):
        own, properties = _graph_id(feature), feature.get("properties") or {}
        changes = {"id": renumbered[own]} if own in renumbered else {}
        if (feature.get("geometry") or {}).get("type") in LINES:
            ends = {name: whole(properties.get(name)) for name in ("startid", "endid")}
            known = {name: end for name, end in ends.items() if end is not None}
            changes |= {
                n: points[end] for n, end in known.items() if end in points and points[end] != end
            }
            if not set(known.values()) <= node_ids | points.keys():
                lost.append(f"features[{number}]" if own is None else str(own))
        kept.append({**feature, "properties": {**properties, **changes}} if changes else feature)
    return tuple(kept), lost


def _members(
    old: AnnotatedMap,
    next_arc: int,
    next_id: int,
    nodes: Sequence[Node],
    arcs: Sequence[Arc],
    features: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Members of the file, with the counters of ids where the file itself does not show them."""
    ids = [int(node.id) for node in nodes]
    ids += [edge for arc in arcs for edge in arc.edges or ()]
    ids += [own for own in map(_graph_id, features) if own is not None]
    counters = {"next_id": next_id, "next_arc": next_arc}
    shown = {
        "next_id": 1 + max(ids, default=-1),
        "next_arc": 1 + max((arc.id for arc in arcs), default=-1),
    }
    return dict(old.members) | ({} if counters == shown else {COUNTERS: counters})


def _notes(
    gone_nodes: Sequence[int],
    gone_arcs: Sequence[int],
    half: Sequence[int],
    gone_half: Sequence[int],
    renumbered: Mapping[int, int],
    lost_ends: Sequence[str],
) -> tuple[str, ...]:
    """A line on each kind of thing that could not be kept as it was."""
    notes = []
    if gone_nodes or gone_arcs:
        nodes = f": ids {_listed(gone_nodes)}" if gone_nodes else ""
        lost = f": arcs {_listed(gone_arcs)}" if gone_arcs else ""
        notes.append(
            f"map.geojson: annotations of {len(gone_nodes)} nodes{nodes} and of "
            f"{len(gone_arcs)} arcs{lost} are gone with them"
        )
    if half:
        notes.append(
            f"map.geojson: arcs {_listed(half)} had one direction only and have two again; "
            "close one by a property of your own"
        )
    if gone_half:
        notes.append(
            f"map.geojson: arcs {_listed(gone_half)}, of one direction only, are gone; those in "
            "their place have two"
        )
    if renumbered:
        pairs = [f"{before} is now {after}" for before, after in renumbered.items()]
        notes.append(
            f"map.geojson: new landmarks have the ids of edges or features: {_listed(pairs)}"
        )
    if lost_ends:
        notes.append(
            f"map.geojson: your edges {_listed(lost_ends)} end at nodes that are gone; "
            "nav2_route refuses such a file"
        )
    return tuple(notes)


def _listed(items: Sequence[Any]) -> str:
    """The first items, separated by commas."""
    shown = ", ".join(str(item) for item in items[:MAX_NOTED])
    return shown + (", ..." if len(items) > MAX_NOTED else "")
