"""The map in an output folder of `jaxslam run` or `jaxslam map`, as a planner needs it."""

from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxslam.core import polylines
from jaxslam.core.maps import MAX_COORDINATE, OccupancyMap, TopologicalMap
from jaxslam.core.regions import Regions
from jaxslam.core.types import CORNER, JUNCTION
from jaxslam.io import annotated_map, rooms_file, ros_map
from jaxslam.io.annotated_map import (
    LINES,
    AnnotatedMap,
    OldEdge,
    OldNode,
    line_points,
    position,
    whole,
)
from jaxslam.io.errors import InputError

GRAPH, OCCUPANCY, ROOMS = "map.geojson", "map.yaml", "rooms.json"
USERS = -1  # id of the arcs of a user


class MapFolder(NamedTuple):
    """The map in a folder.

    Attributes:
        graph: Topological map, with the nodes and edges that a user added.
        directed: (A,) bool arcs that have an edge in the direction of their polylines alone.
        arc_id: (A,) int ids of the arcs, `USERS` for those of a user.
        occupancy: Occupancy map, if the folder has one.
        regions: Rooms and doors, if it has them.
        notes: What is missing or left out.
    """

    graph: TopologicalMap
    directed: np.ndarray
    arc_id: np.ndarray
    occupancy: OccupancyMap | None
    regions: Regions | None
    notes: tuple[str, ...]


class _Road(NamedTuple):
    """An arc of the file: its id, its edge there, and whether it has one back."""

    arc: int
    edge: OldEdge
    both: bool


def read_map_folder(path: str | PathLike) -> MapFolder:
    """Read the map.geojson of a folder and, where there are any, map.yaml and rooms.json.

    An edge that was deleted is a direction that may not be driven. What a user added counts, too:
    Points with an id are nodes, lines between two nodes are edges in one direction.

    Args:
        path: The folder, or its map.geojson.

    Raises:
        InputError: There is no such folder or no map.geojson in it, or a file cannot be read.
    """
    path = Path(path)
    folder = path.parent if path.name == GRAPH and not path.is_dir() else path
    advice = "name an output folder of `jaxslam run` or `jaxslam map`"
    if not folder.is_dir():
        problem = "is no folder" if folder.exists() else "does not exist"
        raise InputError(problem, path=folder, advice=advice)
    again = "correct it, or make the map anew with `jaxslam run` or `jaxslam map`"
    known = annotated_map.read(folder / GRAPH, advice=again)
    if known is None:
        raise InputError(f"holds no {GRAPH}", path=folder, advice=advice)
    nodes = [*known.nodes, *_users_nodes(known)]
    for node in nodes:
        if not np.isfinite(node.xy).all():
            problem = f"has no position within {MAX_COORDINATE:g} m of 0, 0"
            advice, field = "give it two coordinates [m]", f"node {node.id}"
            raise InputError(problem, path=folder / GRAPH, field=field, advice=advice)
    index = {node.id: n for n, node in enumerate(nodes)}
    roads = [*_roads(known), *_users_roads(known, folder / GRAPH)]
    joined = [r for r in roads if r.edge.start in index and r.edge.end in index]
    notes = []
    if len(joined) < len(roads):
        left_out = len(roads) - len(joined)
        notes.append(f"arcs of {GRAPH} that end at no node are left out: {left_out}")
    occupancy = None
    if (folder / OCCUPANCY).exists():
        occupancy = ros_map.read(folder / OCCUPANCY)
        notes += [f"{folder / OCCUPANCY}: {note}" for note in occupancy.notes]
    else:
        notes.append(f"no {OCCUPANCY}: obstacles beside the arcs are not known")
    return MapFolder(
        graph=_graph(nodes, joined, index),
        directed=np.array([not road.both for road in joined], bool),
        arc_id=np.array([road.arc for road in joined], int),
        occupancy=occupancy,
        regions=_regions(folder),
        notes=tuple(notes),
    )


def _regions(folder: Path) -> Regions | None:
    """Rooms and doors of a folder, if it has any."""
    path = folder / rooms_file.JSON_NAME
    return rooms_file.read_rooms(path) if path.is_file() else None


def _graph(
    nodes: Sequence[OldNode], roads: Sequence[_Road], index: dict[int, int]
) -> TopologicalMap:
    """The topological map of nodes, and of arcs between them."""
    xy = np.array([node.xy for node in nodes], float).reshape(-1, 2)
    ends = np.array([[index[r.edge.start], index[r.edge.end]] for r in roads], int).reshape(-1, 2)
    lines = [_line(road.edge, xy[pair]) for road, pair in zip(roads, ends, strict=True)]
    return TopologicalMap(
        id=np.array([node.id for node in nodes], int),
        xy=xy,
        kind=np.array([CORNER if node.kind == "corner" else JUNCTION for node in nodes], int),
        clearance=np.array([node.clearance for node in nodes], float),
        arc_ends=ends,
        arc_length=np.array([polylines.length(line) for line in lines], float),
        arc_clearance=np.array([road.edge.clearance for road in roads], float),
        arc_lines=tuple(lines),
    )


def _line(edge: OldEdge, ends: np.ndarray) -> np.ndarray:
    """Polyline (n, 2) [m] of an edge, between the positions (2, 2) of its nodes."""
    line = ends if edge.line is None else edge.line
    before = [ends[:1]] if np.abs(line[0] - ends[0]).max() > 1e-6 else []
    after = [ends[1:]] if np.abs(line[-1] - ends[1]).max() > 1e-6 else []
    return np.concatenate([*before, line, *after])


def _roads(known: AnnotatedMap) -> Iterator[_Road]:
    """The arcs, in the direction of the first of their edges."""
    for arc in known.arcs:
        edge, *back = arc.edges
        if edge.line is None and back and back[0].line is not None:
            edge = edge._replace(line=back[0].line[::-1])
        yield _Road(arc.id, edge, bool(back))


def _users_nodes(known: AnnotatedMap) -> Iterator[OldNode]:
    """Points that a user added, with an id."""
    for feature in known.features:
        geometry, properties = feature.get("geometry") or {}, feature.get("properties") or {}
        node_id, xy = whole(properties.get("id")), position(geometry)
        if geometry.get("type") == "Point" and node_id is not None and np.isfinite(xy).all():
            yield OldNode(node_id, "", properties, xy)


def _users_roads(known: AnnotatedMap, path: Path) -> Iterator[_Road]:
    """Lines from node to node that a user added; two that lead there and back are one arc."""
    edges: dict[tuple[int, int], OldEdge] = {}
    for number, feature in enumerate(known.features):
        geometry, properties = feature.get("geometry") or {}, feature.get("properties") or {}
        start, end = whole(properties.get("startid")), whole(properties.get("endid"))
        if geometry.get("type") in LINES and start is not None and end is not None:
            try:
                line = line_points(geometry)
            except ValueError as error:
                field = f"line {properties.get('id', number)}"
                raise InputError(str(error), path=path, field=field) from None
            edges[start, end] = OldEdge(number, start, end, np.nan, line, properties)
    for (start, end), edge in edges.items():
        if start < end or (end, start) not in edges:
            yield _Road(USERS, edge, (end, start) in edges)
