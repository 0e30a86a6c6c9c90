"""Topological maps as route graphs of straight edges, for the controllers behind nav2_route.

nav2_route leads a robot straight from node to node: the polylines of `map.geojson` are not driven.
Here the points of `straight_lanes` are nodes, so that no edge is farther than a tolerance from its
arc. The map's nodes keep their ids, `metadata.map_arc` is the arc of the map, and a door is opened
by the short edges up to 1 m before and behind it.
"""

from os import PathLike

import numpy as np

from jaxslam.core.maps import TopologicalMap
from jaxslam.io import geojson
from jaxslam.io.nav2_metadata import door_operations, edge_metadata, node_metadata
from jaxslam.io.straight_lanes import StraightLanes


def write(path: str | PathLike, graph: TopologicalMap, layout: StraightLanes) -> None:
    """Write the lanes of a map.

    Args:
        path: File to write, atomically.
        graph: The map.
        layout: Its points and lanes.

    Raises:
        InputError: The file cannot be written.
    """
    known = [int(name) for name in layout.names if name.isdecimal()]
    taken = np.concatenate([graph.id, graph.frontier_id]).astype(int).tolist()
    first = 1 + max(taken, default=-1)
    ids = [*known, *range(first, first + len(layout.names) - len(known))]
    nodes = [
        geojson.Node(
            node, float(x), float(y), geojson.KINDS[0], np.nan, metadata=node_metadata(label)
        )
        for node, (x, y), label in zip(ids, layout.xy, layout.labels, strict=True)
    ]
    arcs = []
    for number, lane in enumerate(layout.lanes):
        points = layout.xy[[lane.start, lane.end]]
        arcs.append(
            geojson.Arc(
                number,
                ids[lane.start],
                ids[lane.end],
                float(np.hypot(*(points[1] - points[0]))),
                np.nan,
                points,
                metadata=edge_metadata(lane.label, lane.speed) | {"map_arc": lane.arc},
                operations=door_operations(lane.label),
            )
        )
    geojson.write(path, nodes, arcs)
