"""Maps: the global topological map, routes over it, occupancy map, pose graph, grid topology."""

from typing import TYPE_CHECKING

from jaxslam.core.lazy import lazy_names

if TYPE_CHECKING:
    from jaxslam.core.maps import OccupancyMap as OccupancyMap
    from jaxslam.core.maps import TopologicalMap as TopologicalMap
    from jaxslam.mapping.arc_table import ArcTable as ArcTable
    from jaxslam.mapping.arc_table import add_scan_arcs as add_scan_arcs
    from jaxslam.mapping.arc_table import empty_arcs as empty_arcs
    from jaxslam.mapping.arc_table import grow_arcs as grow_arcs
    from jaxslam.mapping.config import MappingSpec as MappingSpec
    from jaxslam.mapping.global_map import GlobalMap as GlobalMap
    from jaxslam.mapping.global_map import build_global_map as build_global_map
    from jaxslam.mapping.grid_topology import GridTopology as GridTopology
    from jaxslam.mapping.grid_topology import extract_topology as extract_topology
    from jaxslam.mapping.occupancy import occupancy_map as occupancy_map
    from jaxslam.mapping.planning import PlannedRoute as PlannedRoute
    from jaxslam.mapping.planning import drivable as drivable
    from jaxslam.mapping.planning import route as route
    from jaxslam.mapping.pose_graph import PoseGraph as PoseGraph
    from jaxslam.mapping.pose_graph import build_pose_graph as build_pose_graph
    from jaxslam.mapping.rooms import find_regions as find_regions
    from jaxslam.mapping.routes import Route as Route
    from jaxslam.mapping.routes import find_route as find_route
    from jaxslam.mapping.routes import shortest_path as shortest_path
    from jaxslam.mapping.saved_map import SavedMap as SavedMap
    from jaxslam.mapping.topological_map import build_map as build_map

__getattr__, __all__ = lazy_names(  # noqa: PLE0604
    __name__,
    {
        "jaxslam.core.maps": "OccupancyMap TopologicalMap",
        "jaxslam.mapping.arc_table": "ArcTable add_scan_arcs empty_arcs grow_arcs",
        "jaxslam.mapping.config": "MappingSpec",
        "jaxslam.mapping.global_map": "GlobalMap build_global_map",
        "jaxslam.mapping.grid_topology": "GridTopology extract_topology",
        "jaxslam.mapping.occupancy": "occupancy_map",
        "jaxslam.mapping.planning": "PlannedRoute drivable route",
        "jaxslam.mapping.pose_graph": "PoseGraph build_pose_graph",
        "jaxslam.mapping.rooms": "find_regions",
        "jaxslam.mapping.routes": "Route find_route shortest_path",
        "jaxslam.mapping.saved_map": "SavedMap",
        "jaxslam.mapping.topological_map": "build_map",
    },
)
