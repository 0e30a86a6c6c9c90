"""The command `jaxslam map MAP.yaml`."""

from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from jaxslam.cli import report, summaries
from jaxslam.cli.options import OutFolder, check_range, name_errors
from jaxslam.evaluation import map_metrics
from jaxslam.io import graphml, ros_map
from jaxslam.io.output import folder, write_json
from jaxslam.mapping import grid_topology

MIN_REGION_AREA = 1.0  # [m^2] of the smallest region that `map --regions all` keeps


def map_occupancy(
    map_file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP.yaml")],
    robot_radius: float = 0.25,
    min_obstacle_size: float = 0.1,
    regions: Literal["largest", "all"] = "largest",
    out: OutFolder = Path("out"),
) -> None:
    """Extract the topological map of a ROS occupancy grid.

    Writes metrics.json, map.geojson, map.graphml, map.lif.json and map.rmf.yaml, for fleets, and
    map.png; needs the extras [ros] and [graph].

    Args:
        map_file: YAML file of map_server, with its image in the same folder.
        robot_radius: Robot radius [m]: least distance of nodes and arcs to obstacles.
        min_obstacle_size: Minimum obstacle size [m]: smaller ones in free space are noise.
        regions: Connected regions of the robot's centre: the largest, or all of at least 1 m^2.
        out: Folder for the results.
    """
    check_range("--robot-radius", robot_radius, 0.01, 100.0)
    check_range("--min-obstacle-size", min_obstacle_size, 0.0, 100.0)
    graphml.require()
    grid = ros_map.read(map_file)
    rows, columns = grid.free.shape
    print(f"{map_file}: {rows} x {columns} cells of {grid.resolution:g} m", flush=True)
    for note in grid.notes:
        print(f"note: {note}", flush=True)
    stages = (*grid_topology.STAGES, "writing")
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
        seconds = {"run": perf_counter() - start}
        show_progress("writing")
        numbers = map_metrics.map_metrics(result)
        numbers |= {"clearance_m": robot_radius, "seconds": seconds}
        write_json(out_dir / "metrics.json", numbers)
        report.write_map(out_dir / "map.geojson", result.graph)
        report.write_exports(out_dir, result.graph)
        report.draw_map(out_dir / "map.png", grid, result.graph)
        bar.update()
    title = f"{map_file}: robot radius {robot_radius:g} m, regions {result.num_regions}"
    summaries.print_map_summary(numbers, title, out)
