"""Numbers of a topological map of an occupancy grid, with the keys of `metrics.json`."""

import numpy as np

from jaxslam.core.types import Metrics
from jaxslam.mapping.grid_topology import GridTopology


def map_metrics(topology: GridTopology) -> Metrics:
    """Numbers of the topological map of an occupancy grid: counts, lengths [m], areas [m^2]."""
    graph = topology.graph
    degree = np.bincount(graph.arc_ends.ravel(), minlength=len(graph.id))
    return {
        "nodes": len(graph.id),
        "arcs": len(graph.arc_ends),
        "dead_ends": int(np.sum(degree == 1)),
        "rings": len(graph.arc_ends) - len(graph.id) + topology.num_regions,
        "regions": topology.num_regions,
        "length_m": float(graph.arc_length.sum()),
        "narrowest_m": float(min(graph.arc_clearance, default=np.nan)),
        "reached_m2": topology.reached_area,
        "left_out_m2": topology.unreached_area,
    }
