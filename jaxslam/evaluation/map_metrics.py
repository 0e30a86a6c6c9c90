"""Numbers of a topological map of an occupancy grid, with the keys of `metrics.json`."""

import numpy as np

from jaxslam.evaluation.log_errors import Metrics
from jaxslam.mapping.grid_topology import GridTopology


def map_metrics(survey: GridTopology) -> Metrics:
    """Numbers of the topological map of an occupancy grid."""
    graph = survey.graph
    degree = np.bincount(graph.arc_ends.ravel(), minlength=len(graph.id))
    return {
        "nodes": len(graph.id),
        "arcs": len(graph.arc_ends),
        "dead_ends": int(np.sum(degree == 1)),
        "rings": len(graph.arc_ends) - len(graph.id) + survey.num_regions,
        "regions": survey.num_regions,
        "length_m": float(graph.arc_length.sum()),
        "narrowest_m": float(min(graph.arc_clearance, default=np.nan)),
        "reached_m2": survey.reached_area,
        "left_out_m2": survey.unreached_area,
    }
