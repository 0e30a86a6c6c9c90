"""Files and figures of a result."""

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from jaxslam.cli import map_files
from jaxslam.core.batching import on_device
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.measurement import Measurement
from jaxslam.core.regions import PlannerData, Regions
from jaxslam.core.scan import Scan
from jaxslam.core.types import Metrics
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract, lidar
from jaxslam.io import g2o_writer, geojson, map_file, ros_map, tum
from jaxslam.io.annotated_map import AnnotatedMap
from jaxslam.io.carry_over import carry_over
from jaxslam.io.output import write_json, write_text
from jaxslam.io.route_graph import route_graph
from jaxslam.localisation.config import LocaliseInfo
from jaxslam.mapping import pose_graph
from jaxslam.mapping.saved_map import SavedMap
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.results import SlamResult
from jaxslam.pipeline.saving import to_saved_map
from jaxslam.simulation.worlds import World

# One program, not one for each of its operations.
_beam_ends = jax.jit(jax.vmap(lidar.beam_ends, in_axes=(None, 0)), static_argnums=0)


def write_results(
    out_dir: Path,
    numbers: Metrics,
    topological_map: TopologicalMap,
    old: AnnotatedMap | None = None,
    next_id: int = 0,
    regions: Regions | None = None,
    planner: PlannerData | None = None,
) -> tuple[int, ...]:
    """Write metrics.json and map.geojson to a folder.

    Args:
        out_dir: Folder to write to.
        numbers: Of metrics.json; notes on what of `old` was not kept are added to `mended`.
        topological_map: The map.
        old: As of `write_map`.
        next_id: As of `write_map`.
        regions: As of `write_map`.
        planner: As of `write_map`.

    Returns:
        The ids of the arcs, as of `write_map`.
    """
    path = out_dir / "map.geojson"
    notes, arc_ids = write_map(path, topological_map, old, next_id, regions, planner)
    if notes:
        numbers["mended"] = [*numbers.get("mended", ()), *notes]
    write_json(out_dir / "metrics.json", numbers)
    return arc_ids


def write_maps(
    out_dir: Path,
    config: Config,
    params: NoiseParams,
    result: SlamResult,
    measurements: Measurement,
    times: np.ndarray,
    scans: Scan,
    saved_map: SavedMap | None = None,
    regions: Regions | None = None,
    planner: PlannerData | None = None,
    arc_ids: Sequence[int] | None = None,
) -> None:
    """Write map.yaml, map.pgm, graph.g2o, map.npz and the files of `map_files.write_exports`.

    Args:
        out_dir: Folder to write to.
        config: Configuration of the run.
        params: Noise parameters of the filter.
        result: Result of SLAM.
        measurements: [K] inputs of the filter.
        times: (K,) [s] of the keyframes.
        scans: [K] of the keyframes.
        saved_map: The map that the run went on in, if any.
        regions: Rooms and doors of the map.
        planner: Where its nodes and arcs lie.
        arc_ids: Of its arcs and open ends in map.geojson; by default their indices.
    """
    poses = result.poses[result.keyframes]
    kept = to_saved_map(config, params, result, times, scans, saved_map)
    if result.occupancy is not None:
        ros_map.write(out_dir / "map.yaml", result.occupancy)
    graph = pose_graph.build_pose_graph(
        config.filter,
        params,
        poses,
        result.belief,
        result.info,
        measurements,
        result.loop_closures,
    )
    g2o_writer.write(out_dir / "graph.g2o", graph)
    map_file.write(out_dir / map_file.NAME, kept)
    radius = config.mapping.robot_radius
    map_files.write_exports(
        out_dir, result.topological_map, regions, planner, arc_ids, robot_radius=radius
    )


def draw_scan(path: Path, config: Config, scans: Scan, number: int) -> None:
    """Draw the local Voronoi diagram of scan `number` of [T]."""
    from jaxslam.viz import canvas, landmarks  # imported here: matplotlib is slow to import

    scan = jax.tree.map(lambda leaf: leaf[number], scans)
    features, diagram, sources = jax.jit(extract.extract_diagram, static_argnums=0)(
        config.frontend, scan
    )
    figure, axes = canvas.canvas(8.0, 4.6)
    landmarks.draw_local_diagram(axes[0, 0], diagram, sources, config.frontend.grid, features)
    axes[0, 0].set_title(f"scan {number}")
    canvas.legend(figure)
    figure.savefig(path)


def write_map(
    path: Path,
    graph: TopologicalMap,
    old: AnnotatedMap | None = None,
    next_id: int = 0,
    regions: Regions | None = None,
    planner: PlannerData | None = None,
) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Write a topological map as GeoJSON.

    Args:
        path: File to write.
        graph: The map.
        old: Map of the sessions before, as `annotated_map.read` gives it: ids of arcs and what a
            user added are carried over.
        next_id: Id of the next landmark; edges have ids from there on.
        regions: Rooms and doors of the map.
        planner: Where its nodes and arcs lie.

    Returns:
        Notes on what of `old` could not be kept as it was, and the ids of the arcs, those to open
        ends last.
    """
    nodes, arcs = route_graph(graph, regions, planner)
    if old is None:
        geojson.write(path, nodes, arcs, next_id=next_id)
        return (), tuple(arc.id for arc in arcs)
    kept = carry_over(old._replace(next_id=max(old.next_id, next_id)), nodes, arcs)
    geojson.write(path, kept.nodes, kept.arcs, features=kept.features, members=kept.members)
    return kept.notes, tuple(arc.id for arc in kept.arcs)


def draw(
    out_dir: Path,
    config: Config,
    result: SlamResult,
    lines: dict[str, np.ndarray],
    error: np.ndarray | None,
    *,
    world: World | None = None,
    scans: Scan | None = None,
    saved_scans: Scan | None = None,
    wrong: Sequence[tuple[int, int]] = (),
) -> None:
    """Draw path.png and errors.png.

    Args:
        out_dir: Folder to write to.
        config: Configuration of the filter.
        result: Result of SLAM.
        lines: Other trajectories (N, 3) by their name in `TRAJECTORY_STYLES`.
        error: (K, 3) pose errors [m, m, rad] of the keyframes, if known.
        world: World whose walls are drawn.
        scans: Scans [K] of the keyframes, whose end points are drawn.
        saved_scans: Scans [S] of the saved keyframes, likewise.
        wrong: First and last number of scans where the map contradicts itself.
    """
    # Imported here, because matplotlib is slow to import.
    from jaxslam.viz import canvas, charts, landmarks, maps

    poses = result.poses
    walls = [] if world is None else [np.reshape(world.walls, (-1, 2))]
    # The odometry of a log may leave the map: it does not set the limits of the axes.
    limiting = [line for what, line in lines.items() if scans is None or what != "odometry"]
    figure, axis = canvas.map_canvas(
        *canvas.extent(poses, result.topological_map.xy, *limiting, *walls)
    )
    if world is not None:
        maps.draw_walls(axis, world)
    if scans is not None:
        points = _beam_ends(config.frontend.lidar, scans)
        maps.draw_hits(axis, poses[result.keyframes], np.asarray(points), np.asarray(scans.hit))
    if saved_scans is not None and result.saved_poses is not None:
        points = _beam_ends(config.frontend.lidar, saved_scans)
        hit = np.asarray(saved_scans.hit)
        maps.draw_hits(axis, result.saved_poses, np.asarray(points), hit)
    breaks = np.flatnonzero(np.diff(result.piece)) + 1  # across which no line is drawn
    estimate = np.insert(poses, breaks, np.nan, axis=0)
    for what, line in (lines | {"estimate": estimate}).items():
        maps.draw_trajectory(axis, line, what)
    maps.draw_wrong_parts(axis, poses, wrong)
    maps.draw_arcs(axis, result.topological_map)
    landmarks.draw_landmarks(axis, result.belief, confirm_count=config.filter.confirm_count)
    maps.draw_start_and_end(axis, poses[np.isfinite(poses).all(axis=1)])
    canvas.legend(figure)
    figure.savefig(out_dir / "path.png")

    figure, axes = canvas.canvas(9.0, 6.0, 3)
    charts.draw_errors(axes[:, 0], np.asarray(result.info.pose_cov), error, result.keyframes)
    figure.savefig(out_dir / "errors.png")


def write_localisation(
    out_dir: Path, numbers: Metrics, times: np.ndarray, infos: LocaliseInfo, likely: float
) -> None:
    """Write metrics.json, quality.csv, and of poses that are `likely` trajectory.tum.

    Args:
        out_dir: Folder to write to.
        numbers: Of metrics.json.
        times: (T,) [s] of the scans.
        infos: [T], NumPy.
        likely: Least probability of a pose of trajectory.tum.
    """
    write_json(out_dir / "metrics.json", numbers)
    poses = np.asarray(infos.pose, np.float64)
    chosen = infos.probability >= likely
    tum.write(out_dir / "trajectory.tum", times[chosen], poses[chosen])
    rows = zip(times, *poses.T, infos.probability, strict=True)
    lines = [f"{t:.6f},{x:.4f},{y:.4f},{yaw:.5f},{p:.4f}" for t, x, y, yaw, p in rows]
    write_text(out_dir / "quality.csv", "\n".join(["t,x,y,yaw,probability", *lines, ""]))


def draw_localisation(path: Path, saved_map: SavedMap, infos: LocaliseInfo) -> None:
    """Draw the poses of a log, by their probability, over the walls of a map."""
    from jaxslam.viz import canvas, maps  # imported here, because matplotlib is slow to import

    scans = saved_map.scans._replace(ranges=on_device(saved_map.scans.ranges))
    points = _beam_ends(saved_map.lidar, scans)
    figure, axis = canvas.map_canvas(*canvas.extent(saved_map.poses))
    maps.draw_hits(axis, saved_map.poses, np.asarray(points), np.asarray(scans.hit))
    maps.draw_probable_poses(axis, infos.pose, infos.probability)
    figure.savefig(path)
