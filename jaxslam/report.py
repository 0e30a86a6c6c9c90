"""Results of the commands: numbers, files, plots and printed summaries."""

import os
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import lidar, losses, mapping, metrics, slam
from jaxslam.fit import Fit, names
from jaxslam.io import geojson, graphml, occupancy, posegraph, tum
from jaxslam.io.occupancy import Occupancy
from jaxslam.io.output import write_json
from jaxslam.io.recording import Recording
from jaxslam.io.relations import Relations
from jaxslam.lidar import Scan
from jaxslam.monte_carlo import Track
from jaxslam.online import Survey
from jaxslam.poses import seen_from
from jaxslam.skeleton import Survey as MapSurvey
from jaxslam.slam import Config, Inputs, Noise
from jaxslam.topomap import Graph
from jaxslam.types import NODE
from jaxslam.world import World

KINDS = ("node", "corner", "wall")
CELL = 0.05  # [m] resolution of the occupancy grid

Numbers = dict[str, Any]
"""Content of `metrics.json`."""

Trajectory = tuple[np.ndarray, np.ndarray]
"""Times (N,) [s] and poses (N, 3) [m, m, rad]."""


def error_of(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors (..., 3) [m, m, rad] of poses (..., 3), world frame."""
    return np.asarray(metrics.pose_error(jnp.asarray(poses, float), jnp.asarray(truth, float)))


def length(poses: np.ndarray) -> float:
    """Path length [m] of a trajectory (T, 3)."""
    return float(np.sum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))


def aligned_error(tracks: Track) -> float | None:
    """ATE RMSE [m] over Monte-Carlo trials, each aligned on its own; None if none is finite."""
    stamps = np.arange(tracks.truth.shape[1])
    squares = [
        metrics.ate(stamps, estimate, stamps, truth)["ate_rmse_m"] ** 2
        for estimate, truth in zip(tracks.estimate, tracks.truth, strict=True)
        if np.isfinite(estimate).all()
    ]
    return float(np.sqrt(np.mean(squares))) if squares else None


def against_reference(times: np.ndarray, poses: np.ndarray, known: Trajectory) -> Numbers:
    """ATE, RPE and heading RMSE of poses (T, 3), after rigid alignment with a reference."""
    ref_times, ref_poses = known
    ate = metrics.ate(times, poses, ref_times, ref_poses)
    rpe = metrics.rpe(times, poses, ref_times, ref_poses)
    i, j = metrics.match_times(times, ref_times).T
    frame = metrics.align(poses[i, :2], ref_poses[j, :2])
    turn = seen_from(seen_from(frame, ref_poses[j]), poses[i])[:, 2]
    return ate | rpe | {"heading_rmse_deg": float(np.degrees(np.sqrt(np.mean(turn**2))))}


def nees_of(error: np.ndarray, cov: np.ndarray) -> float | None:
    """Mean NEES per degree of freedom (1 if consistent); None if there is no pose to evaluate.

    Args:
        error: (T, 3) [m, m, rad]; rows that are not finite are left out.
        cov: (T, 3, 3); a pose without uncertainty, such as the first, is left out.
    """
    use = np.isfinite(error).all(axis=1) & (np.trace(cov, axis1=1, axis2=2) > losses.CERTAIN)
    nees = np.asarray(metrics.nees(jnp.asarray(error[use], float), jnp.asarray(cov[use], float)))
    nees = nees[np.isfinite(nees)]
    return float(nees.mean()) / 3.0 if nees.size else None


def against_relations(recording: Recording, poses: np.ndarray, verified: Relations) -> Numbers:
    """Relation errors of poses (T, 3): deviations from verified relative poses."""
    errors = metrics.relations_error(
        recording.times, poses, recording.wheel_times, recording.wheel_poses, verified
    )
    return {"relations": errors}


def judged(
    recording: Recording, poses: np.ndarray, known: Trajectory | None, verified: Relations | None
) -> Numbers:
    """Evaluate poses (T, 3) with the reference and with the relations, where given."""
    numbers = {} if known is None else against_reference(recording.times, poses, known)
    return numbers | ({} if verified is None else against_relations(recording, poses, verified))


def beside(times: np.ndarray, poses: np.ndarray, known: Trajectory) -> np.ndarray:
    """Reference poses (K, 3) in the map frame, after rigid alignment with poses (T, 3)."""
    ref_times, ref_poses = known
    i, j = metrics.match_times(times, ref_times).T
    return seen_from(metrics.align(poses[i, :2], ref_poses[j, :2]), ref_poses[j])


def since_start(times: np.ndarray, poses: np.ndarray, known: Trajectory) -> np.ndarray:
    """Errors (T, 3) of poses after alignment at the first matched pose; NaN without reference."""
    ref_times, ref_poses = known
    i, j = metrics.match_times(times, ref_times).T
    origin = np.zeros(3)
    frame = seen_from(seen_from(ref_poses[j[0]], origin), seen_from(poses[i[0]], origin))
    error = np.full(poses.shape, np.nan)
    error[i] = error_of(poses[i], seen_from(frame, ref_poses[j]))
    return error


def write(place: Path, numbers: Numbers, times: np.ndarray, survey: Survey) -> None:
    """Write metrics.json, trajectory.tum and map.geojson to the folder `place`."""
    write_json(place / "metrics.json", numbers)
    tum.write(place / "trajectory.tum", times, survey.poses)
    write_map(place / "map.geojson", survey.graph)


def write_maps(
    place: Path, config: Config, noise: Noise, survey: Survey, inputs: Inputs, scans: Scan
) -> None:
    """Write map.yaml, map.pgm, graph.g2o and, if networkx is installed, map.graphml."""
    grid = mapping.occupancy(survey.poses, scans, config.lidar, resolution=CELL)
    occupancy.write(place / "map.yaml", grid)
    posegraph.write(place / "graph.g2o", mapping.pose_graph(config, noise, survey, inputs))
    if find_spec("networkx") is not None:
        graphml.write(place / "map.graphml", survey.graph)


def draw_scan(path: Path, config: Config, scans: Scan, number: int) -> None:
    """Draw the local Voronoi diagram of scan `number` of [T]."""
    from jaxslam import plot  # imported here, because matplotlib is slow to import

    scan = jax.tree.map(lambda leaf: leaf[number], scans)
    features, diagram, sources = jax.jit(slam.look, static_argnums=0)(config, scan)
    figure, axes = plot.canvas(8.0, 4.6)
    plot.local(axes[0, 0], diagram, sources, config.grid, features)
    axes[0, 0].set_title(f"scan {number}")
    plot.legend(figure)
    figure.savefig(path)


def write_map(path: Path, graph: Graph) -> None:
    """Write a topological map as GeoJSON."""
    nodes = []
    rows = zip(graph.id, graph.xy, graph.kind, graph.clearance, strict=True)
    for node, (x, y), kind, clearance in rows:
        clearance = float(clearance) if kind == NODE else np.nan
        nodes.append(geojson.Node(int(node), float(x), float(y), KINDS[kind], clearance))
    arcs = [
        geojson.Arc(
            index,
            int(graph.id[start]),
            int(graph.id[end]),
            float(graph.length[index]),
            float(graph.arc_clearance[index]),
            graph.lines[index],
        )
        for index, (start, end) in enumerate(graph.pairs)
    ]
    geojson.write(path, nodes, arcs)


def draw(
    place: Path,
    config: Config,
    survey: Survey,
    lines: dict[str, np.ndarray],
    error: np.ndarray | None,
    *,
    world: World | None = None,
    scans: Scan | None = None,
) -> None:
    """Draw path.png and errors.png.

    Args:
        place: Folder to write to.
        config: Configuration of the filter.
        survey: Result of SLAM.
        lines: Other trajectories (N, 3) by their name in `plot.LINES`.
        error: (T, 3) pose errors [m, m, rad], if known.
        world: World whose walls are drawn.
        scans: Scans [T] whose end points are drawn.
    """
    from jaxslam import plot  # imported here, because matplotlib is slow to import

    poses = survey.poses
    walls = [] if world is None else [np.reshape(world.walls, (-1, 2))]
    # The odometry of a log may leave the map: it does not set the limits of the axes.
    limiting = [line for what, line in lines.items() if scans is None or what != "odometry"]
    figure, axis = plot.plan(*plot.extent(poses, survey.graph.xy, *limiting, *walls))
    if world is not None:
        plot.walls(axis, world)
    if scans is not None:
        points = jax.vmap(lidar.points, in_axes=(0, None))(scans, config.lidar)
        plot.echoes(axis, poses, np.asarray(points), np.asarray(scans.hit))
    for what, line in (lines | {"estimate": poses}).items():
        plot.trajectory(axis, line, what)
    plot.arcs(axis, survey.graph)
    plot.landmarks(axis, survey.belief, confirm=config.confirm)
    plot.ends(axis, poses)
    plot.legend(figure)
    figure.savefig(place / "path.png")

    figure, axes = plot.canvas(9.0, 6.0, 3)
    plot.errors(axes[:, 0], np.asarray(survey.info.pose_cov), error)
    figure.savefig(place / "errors.png")


ROWS = (
    ("position_rmse_m", "position RMSE", "m"),
    ("heading_rmse_deg", "heading RMSE", "deg"),
    ("ate_rmse_m", "ATE RMSE", "m"),
    ("rpe_translation_rmse_m", "RPE translation (delta 1 m)", "m"),
    ("rpe_rotation_rmse_deg", "RPE rotation (delta 1 m)", "deg"),
    ("translation_mean_m", "relation error, translation", "m"),
    ("rotation_mean_deg", "relation error, rotation", "deg"),
)


def tell(numbers: Numbers, title: str, out: Path) -> None:
    """Print a summary of the `metrics.json` of a run or of Monte-Carlo trials."""
    print(f"\n{title}; path length {numbers['path_length_m']:.0f} m")
    if numbers.get("skipped_lines"):
        print(f"{numbers['skipped_lines']} broken lines, or scans without odometry, skipped")
    for repair in numbers.get("mended", ()):
        print(f"odometry repairs: {repair}")
    odometry = numbers.get("dead_reckoning", {})
    if odometry:
        print(f"{'':36}{'SLAM':>10}{'odometry':>10}{'ratio':>8}")
    _print_errors(numbers | numbers.get("relations", {}), odometry | odometry.get("relations", {}))
    if "diverged" in numbers:
        print(f"  {'diverged trials':34}{numbers['diverged']:10d}{odometry['diverged']:10d}")
    if numbers.get("nees") is not None:
        print(f"  {'NEES per dof (1 if consistent)':34}{numbers['nees']:10.3f}")
    print(f"  {'landmarks':34}{numbers['landmarks']:10.0f}")
    print(f"  {'updates per scan':34}{numbers['matches']:10.1f}")
    if numbers.get("closures"):
        print(f"  {'loop closures':34}{numbers['closures']:10d}")
    _print_seconds(numbers)
    print(f"results: {out}{os.sep}metrics.json, path.png, errors.png, map.geojson, ...")


def _print_errors(slam_errors: Numbers, odometry_errors: Numbers) -> None:
    """Print the `ROWS` that there are: error of SLAM, of dead reckoning, and their ratio."""
    for key, name, unit in ROWS:
        error = slam_errors.get(key)
        if error is None:
            continue
        line = f"  {f'{name} [{unit}]':34}{error:10.3f}"
        if key in odometry_errors:
            ratio = odometry_errors[key] / error if error else np.inf
            line += f"{odometry_errors[key]:10.3f}{ratio:8.1f}"
        print(line)


def of_map(survey: MapSurvey) -> Numbers:
    """Numbers of the topological map of an occupancy grid."""
    graph = survey.graph
    degree = np.bincount(graph.pairs.ravel(), minlength=len(graph.id))
    return {
        "nodes": len(graph.id),
        "arcs": len(graph.pairs),
        "dead_ends": int(np.sum(degree == 1)),
        "rings": len(graph.pairs) - len(graph.id) + survey.regions,
        "regions": survey.regions,
        "length_m": float(graph.length.sum()),
        "narrowest_m": float(min(graph.arc_clearance, default=np.nan)),
        "reached_m2": survey.reached,
        "left_out_m2": survey.left_out,
    }


def draw_map(path: Path, occupancy: Occupancy, graph: Graph) -> None:
    """Draw an occupancy grid with its topological map."""
    from jaxslam import plot  # imported here, because matplotlib is slow to import

    figure, axis = plot.plan(*plot.extent(plot.outline(occupancy)))
    plot.occupancy(axis, occupancy)
    plot.roads(axis, graph)
    plot.legend(figure)
    figure.savefig(path)


def tell_map(numbers: Numbers, title: str, out: Path) -> None:
    """Print a summary of the `metrics.json` of a topological map."""
    print(f"\n{title}")
    print(f"  {'nodes, dead ends':34}{numbers['nodes']:10d}{numbers['dead_ends']:10d}")
    print(f"  {'arcs, independent cycles':34}{numbers['arcs']:10d}{numbers['rings']:10d}")
    print(f"  {'total arc length [m]':34}{numbers['length_m']:10.1f}")
    if numbers["arcs"]:
        print(f"  {'smallest clearance [m]':34}{numbers['narrowest_m']:10.2f}")
    areas = f"{numbers['reached_m2']:10.1f}{numbers['left_out_m2']:10.1f}"
    print(f"  {'reachable, omitted area [m^2]':34}{areas}")
    print(f"  {'run time [s]':34}{numbers['seconds']['run']:10.1f}")
    print(f"results: {out}{os.sep}metrics.json, map.png, map.geojson, map.graphml")


def _print_seconds(numbers: Numbers) -> None:
    seconds = numbers["seconds"]
    print(f"  {'run time, compile time [s]':34}{seconds['run']:10.1f}{seconds['compile']:10.1f}")


def draw_history(path: Path, found: Fit) -> None:
    """Draw losses and parameters over the evaluations of a tuning."""
    from jaxslam import plot  # imported here, because matplotlib is slow to import

    figure, axes = plot.canvas(11.0, 4.0, 1, 2)
    plot.losses(axes[0, 0], found.loss, found.heldout, found.best)
    values = [np.asarray(x).reshape(len(found.loss), -1) for x in jax.tree.leaves(found.history)]
    plot.parameters(axes[0, 1], names(found.noise), np.concatenate(values, axis=1), found.best)
    figure.savefig(path)


def tell_tuning(numbers: Numbers, title: str, out: Path) -> None:
    """Print a summary of the `metrics.json` of a tuning."""
    before = numbers["before"]
    print(f"\n{title}; {numbers['evaluations']} evaluations, evaluated on {numbers['judged_on']}")
    print(f"  {'':34}{'before':>12}{'after':>12}")
    rows = {"loss": "loss", "position_rmse_m": "position RMSE [m]", "nees": "NEES per dof"}
    rows |= {"heading_rmse_deg": "heading RMSE [deg]", "diverged": "diverged runs"}
    for key, name in rows.items():
        if numbers.get(key) is not None and before.get(key) is not None:
            print(f"  {name:34}{before[key]:12.4g}{numbers[key]:12.4g}")
    _print_noise(before["noise"], numbers["noise"], numbers["standard_errors"] or {})
    for warning in numbers["warnings"]:
        print(f"warning: {warning}")
    _print_seconds(numbers)
    print(f"results: {out}{os.sep}noise.json, metrics.json, history.png")


def _print_noise(before: Noise, after: Noise, standard_errors: Mapping[str, float]) -> None:
    """Print the noise parameters before and after a tuning, with relative standard errors."""
    if standard_errors:
        print(f"  {'noise parameters (Q and R)':34}{'':24}{'standard error':>18}")
    old, new = (
        np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(noise)])
        for noise in (before, after)
    )
    for name, old_value, new_value in zip(names(after), old, new, strict=True):
        error = standard_errors.get(name, np.nan)
        text = "" if np.isnan(error) else "unknown" if np.isinf(error) else f"{error:.0%}"
        print(f"  {name:34}{old_value:12.4g}{new_value:12.4g}{text:>18}".rstrip())
