"""The command `jaxslam map MAP.yaml`."""

import os
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from jaxslam.cli import map_files, room_results, summaries
from jaxslam.cli.options import (
    OptionalLength,
    OutFolder,
    check_range,
    name_errors,
    require_other_folder,
)
from jaxslam.core.maps import MAX_RESOLUTION, MIN_RESOLUTION, OccupancyMap
from jaxslam.evaluation import map_metrics
from jaxslam.io import geojson, graphml, pictures, ros_map
from jaxslam.io.errors import InputError
from jaxslam.io.output import folder, write_json
from jaxslam.io.route_graph import route_graph
from jaxslam.mapping import grid_topology
from jaxslam.mapping.planner_data import planner_data

MIN_REGION_AREA = 1.0  # [m^2] of the smallest region that `map --regions all` keeps


def map_occupancy(
    map_file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")],
    robot_radius: float = 0.25,
    min_obstacle_size: float = 0.1,
    regions: Literal["largest", "all"] = "largest",
    resolution: OptionalLength = None,
    out: OutFolder = Path("out"),
) -> None:
    """Extract the topological map, the rooms and the doors of an occupancy grid.

    Writes metrics.json, map.geojson, map.graphml, map.nav2.geojson, map.lif.json and map.rmf.yaml,
    for robots and fleets, map.png, rooms.json and rooms.png, and the grid itself as map.yaml and
    map.pgm; needs the extras [ros] and [graph]. Rooms and doors keep their names of an earlier call
    with the same folder.

    Args:
        map_file: YAML file of map_server, with its image in the same folder; or a picture alone,
            white where it is free, black or else darker where there are walls; a grey around dark
            outlines is unknown.
        robot_radius: Robot radius [m]: least distance of nodes and arcs to obstacles.
        min_obstacle_size: Minimum obstacle size [m]: smaller ones in free space are noise.
        regions: Connected regions of the robot's centre: the largest, or all of at least 1 m^2.
        resolution: Side of a cell [m] of a picture alone; a YAML file has its own.
        out: Folder for the results.
    """
    check_range("--robot-radius", robot_radius, 0.01, 100.0)
    check_range("--min-obstacle-size", min_obstacle_size, 0.0, 100.0)
    if (out / "map.npz").exists():  # of `jaxslam run`, with more than is written here
        require_other_folder(out, map_file)
    graphml.require()
    grid = _read(map_file, resolution)
    earlier, notes = room_results.earlier_rooms(out)
    overwritten = _overwritten(map_file, out)
    if overwritten:
        notes = (*notes, f"map.yaml and map.pgm are not written: {overwritten} is an input")
    rows, columns = grid.free.shape
    print(f"{map_file}: {rows} x {columns} cells of {grid.resolution:g} m", flush=True)
    for note in (*grid.notes, *notes):
        print(f"note: {note}", flush=True)
    stages = (*grid_topology.STAGES, "rooms", "writing")
    with (
        folder(out) as out_dir,
        tqdm(total=len(stages), unit="stage", delay=0.5, mininterval=0) as bar,
    ):

        def show_progress(stage: str) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(stages.index(stage) - bar.n)

        start = perf_counter()
        with name_errors(str(map_file)):
            result = grid_topology.extract_topology(
                grid.occupied,
                grid.free,
                resolution=grid.resolution,
                origin=grid.origin,
                robot_radius=robot_radius,
                min_obstacle_size=min_obstacle_size,
                min_region_area=MIN_REGION_AREA if regions == "all" else None,
                callback=show_progress,
            )
        show_progress("rooms")
        rooms = room_results.write_rooms_of(out_dir, grid, earlier, robot_radius=robot_radius)
        seconds = {"run": perf_counter() - start}
        show_progress("writing")
        numbers = map_metrics.map_metrics(result)
        numbers |= {"rooms": len(rooms.regions), "doors": len(rooms.doors)}
        numbers |= {"robot_radius_m": robot_radius, "seconds": seconds}
        write_json(out_dir / "metrics.json", numbers)
        data = planner_data(result.graph, grid, rooms)
        geojson.write(out_dir / "map.geojson", *route_graph(result.graph, rooms, data))
        if not overwritten:
            ros_map.write(out_dir / "map.yaml", grid)
        map_files.write_exports(out_dir, result.graph, rooms, data, robot_radius=robot_radius)
        map_files.draw_map(out_dir / "map.png", grid, result.graph, rooms)
        bar.update()
    note = room_results.without_arcs(rooms, result.graph, data)
    if note:
        print(f"note: {note}")
    title = f"{map_file}: robot radius {robot_radius:g} m, regions {result.num_regions}"
    summaries.print_map_summary(numbers, title, out)


def _read(map_file: Path, resolution: float | None) -> OccupancyMap:
    """The map of a YAML file or of a picture; errors name the option --resolution."""
    picture = pictures.is_picture(map_file)
    if picture and resolution is None:
        advice = "add --resolution METRES, the side of a cell, or name the YAML file of the map"
        raise InputError("is a picture, which has no resolution", path=map_file, advice=advice)
    if resolution is None:
        return ros_map.read(map_file)
    if not picture:
        advice = f"leave it out: {map_file} has its own resolution"
        raise InputError("is for a picture alone", field="--resolution", advice=advice)
    check_range("--resolution", resolution, MIN_RESOLUTION, MAX_RESOLUTION)
    return ros_map.read_picture(map_file, resolution)


def _overwritten(map_file: Path, out: Path) -> str:
    """Name of the input that map.yaml and map.pgm in the output folder would replace, if any."""
    written = [out / "map.yaml", out / "map.pgm"]
    for path in ros_map.files_of(map_file):
        if any(new.exists() and os.path.samefile(new, path) for new in written):
            return str(path)
    return ""
