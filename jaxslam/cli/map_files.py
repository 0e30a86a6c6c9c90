"""Files and the picture of a map."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.regions import PlannerData, Regions
from jaxslam.io import graphml, lif, nav2_lanes, rmf_graph
from jaxslam.io.straight_lanes import straight_lanes


def write_exports(
    out_dir: Path,
    graph: TopologicalMap,
    regions: Regions | None = None,
    planner: PlannerData | None = None,
    arc_ids: Sequence[int] | None = None,
    *,
    robot_radius: float = 0.0,
) -> None:
    """Write map.nav2.geojson, map.lif.json, map.rmf.yaml and, with networkx, map.graphml.

    Args:
        out_dir: Folder to write to.
        graph: The topological map.
        regions: Its rooms and doors.
        planner: Where its nodes and arcs lie.
        arc_ids: Of its arcs and open ends in map.geojson; by default their indices.
        robot_radius: [m] that lanes keep from obstacles, as far as arcs do.
    """
    lanes = straight_lanes(graph, regions, planner, robot_radius=robot_radius, arc_ids=arc_ids)
    nav2_lanes.write(out_dir / "map.nav2.geojson", graph, lanes)
    lif.write(out_dir / "map.lif.json", graph, regions, planner, lanes=lanes)
    rmf_graph.write(out_dir / "map.rmf.yaml", graph, regions, planner, lanes=lanes)
    if find_spec("networkx") is not None:
        graphml.write(out_dir / "map.graphml", graph, regions, planner, arc_ids=arc_ids)


def draw_map(
    path: Path, occupancy: OccupancyMap, graph: TopologicalMap, regions: Regions | None = None
) -> None:
    """Draw an occupancy grid with its topological map, its rooms and its doors."""
    # Imported here, because matplotlib is slow to import.
    from jaxslam.viz import canvas, maps, rooms

    figure, axis = canvas.map_canvas(*canvas.extent(maps.known_corners(occupancy)))
    maps.draw_occupancy(axis, occupancy)
    if regions is not None:
        rooms.draw_rooms(axis, regions)
    maps.draw_topological_map(axis, graph)
    canvas.legend(figure)
    canvas.save(figure, path)
