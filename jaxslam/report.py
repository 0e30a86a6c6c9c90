"""What the command line makes of a result: numbers, files, pictures and a summary."""

import os
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
CELL = 0.05  # [m] of the occupancy map

Numbers = dict[str, Any]
"""What `metrics.json` holds."""

Trajectory = tuple[np.ndarray, np.ndarray]
"""Times (N,) [s] and poses (N, 3)."""


def error_of(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors (..., 3) [m, m, rad] of poses (..., 3), world frame."""
    return np.asarray(metrics.pose_error(jnp.asarray(poses, float), jnp.asarray(truth, float)))


def length(poses: np.ndarray) -> float:
    """Length [m] of the way along poses (T, 3)."""
    return float(np.sum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))


def aligned_error(tracks: Track) -> float | None:
    """Position RMSE [m] over runs, each aligned as a whole; None if none is finite."""
    stamps = np.arange(tracks.truth.shape[1])
    squares = [
        metrics.ate(stamps, estimate, stamps, truth)["ate_rmse_m"] ** 2
        for estimate, truth in zip(tracks.estimate, tracks.truth, strict=True)
        if np.isfinite(estimate).all()
    ]
    return float(np.sqrt(np.mean(squares))) if squares else None


def against_reference(times: np.ndarray, poses: np.ndarray, known: Trajectory) -> Numbers:
    """Errors of poses (T, 3) after rigid alignment with a reference."""
    numbers = metrics.ate(times, poses, *known) | metrics.rpe(times, poses, *known)
    i, j = metrics.match_times(times, known[0]).T
    frame = metrics.align(poses[i, :2], known[1][j, :2])
    turn = seen_from(seen_from(frame, known[1][j]), poses[i])[:, 2]
    numbers["heading_rmse_deg"] = float(np.degrees(np.sqrt(np.mean(turn**2))))
    return numbers


def nees_of(error: np.ndarray, cov: np.ndarray) -> float | None:
    """Mean NEES per degree of freedom of errors (T, 3), those left out where NaN; None of none.

    Poses that are known for certain, as the first is, are left out.
    """
    use = np.isfinite(error).all(axis=1) & (np.trace(cov, axis1=1, axis2=2) > losses.CERTAIN)
    told = np.asarray(metrics.nees(jnp.asarray(error[use], float), jnp.asarray(cov[use], float)))
    told = told[np.isfinite(told)]
    return float(told.mean()) / 3.0 if told.size else None


def against_relations(recording: Recording, poses: np.ndarray, verified: Relations) -> Numbers:
    """Errors of poses (T, 3) in verified relative poses."""
    wheels = recording.wheel_times, recording.wheel_poses
    return {"relations": metrics.relations_error(recording.times, poses, *wheels, verified)}


def judged(
    recording: Recording,
    poses: np.ndarray,
    known: Trajectory | None,
    verified: Relations | None,
) -> Numbers:
    """Errors of poses (T, 3) against all that is known of a recording's way."""
    numbers = {} if known is None else against_reference(recording.times, poses, known)
    return numbers | ({} if verified is None else against_relations(recording, poses, verified))


def beside(times: np.ndarray, poses: np.ndarray, known: Trajectory) -> np.ndarray:
    """A reference (K, 3) in the frame of the map, aligned as a whole with poses (T, 3)."""
    i, j = metrics.match_times(times, known[0]).T
    return seen_from(metrics.align(poses[i, :2], known[1][j, :2]), known[1][j])


def since_start(times: np.ndarray, poses: np.ndarray, known: Trajectory) -> np.ndarray:
    """Errors (T, 3) of poses to a reference laid on the first they share; NaN where it has none."""
    i, j = metrics.match_times(times, known[0]).T
    zero = np.zeros(3)
    first = seen_from(seen_from(known[1][j[0]], zero), seen_from(poses[i[0]], zero))
    error = np.full(poses.shape, np.nan)
    error[i] = error_of(poses[i], seen_from(first, known[1][j]))
    return error


def write(place: Path, numbers: Numbers, times: np.ndarray, survey: Survey) -> None:
    """Write the files of numbers that every command has."""
    write_json(place / "metrics.json", numbers)
    tum.write(place / "trajectory.tum", times, survey.poses)
    write_map(place / "map.geojson", survey.graph)


def write_maps(
    place: Path, config: Config, noise: Noise, survey: Survey, inputs: Inputs, scans: Scan
) -> None:
    """Write map.yaml, map.pgm, graph.g2o and, where networkx is there, map.graphml."""
    grid = mapping.occupancy(survey.poses, scans, config.lidar, resolution=CELL)
    occupancy.write(place / "map.yaml", grid)
    posegraph.write(place / "graph.g2o", mapping.pose_graph(config, noise, survey, inputs))
    if find_spec("networkx") is not None:
        graphml.write(place / "map.graphml", survey.graph)


def draw_scan(path: Path, config: Config, scans: Scan, number: int) -> None:
    """Draw the local diagram of one of the scans [T]."""
    from jaxslam import plot  # matplotlib takes its time to load

    one = jax.tree.map(lambda x: x[number], scans)
    seen, diagram, sources = jax.jit(slam.look, static_argnums=0)(config, one)
    figure, axes = plot.canvas(8.0, 4.6)
    plot.local(axes[0, 0], diagram, sources, config.grid, seen)
    axes[0, 0].set_title(f"scan {number}")
    plot.legend(figure)
    figure.savefig(path)


def write_map(path: Path, graph: Graph) -> None:
    """Write a topological map."""
    nodes = [
        geojson.Node(int(id), float(x), float(y), KINDS[kind], float(c) if kind == NODE else np.nan)
        for id, (x, y), kind, c in zip(*graph[:2], graph.kind, graph.clearance, strict=True)
    ]
    arcs = [
        geojson.Arc(
            k,
            int(graph.id[a]),
            int(graph.id[b]),
            float(graph.length[k]),
            float(graph.arc_clearance[k]),
            graph.lines[k],
        )
        for k, (a, b) in enumerate(graph.pairs)
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
        config: Of the survey.
        survey: What to draw.
        lines: Trajectories (N, 3) beside the estimate, by the names in `plot.LINES`.
        error: (T, 3) errors, if they are known.
        world: Walls to draw.
        scans: Scans [T] to draw.
    """
    from jaxslam import plot  # matplotlib takes its time to load

    poses = survey.poses
    walls = [] if world is None else [np.reshape(world.walls, (-1, 2))]
    inside = [line for what, line in lines.items() if scans is None or what != "odometry"]
    shown = [poses, survey.graph.xy, *inside, *walls]  # wheels may lead far off the map
    figure, axis = plot.plan(*plot.extent(*shown))
    if world is not None:
        plot.walls(axis, world)
    if scans is not None:
        ends = jax.vmap(lidar.points, in_axes=(0, None))(scans, config.lidar)
        plot.echoes(axis, poses, np.asarray(ends), np.asarray(scans.hit))
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
    ("ate_rmse_m", "position RMSE, aligned", "m"),
    ("rpe_translation_rmse_m", "RMSE of motions of 1 m", "m"),
    ("rpe_rotation_rmse_deg", "RMSE of motions of 1 m", "deg"),
    ("translation_mean_m", "error of relations", "m"),
    ("rotation_mean_deg", "error of relations", "deg"),
)


def tell(numbers: Numbers, title: str, out: Path) -> None:
    """Print a summary of what `metrics.json` holds."""
    print(f"\n{title}; a way of {numbers['path_length_m']:.0f} m")
    if numbers.get("skipped_lines"):
        print(f"{numbers['skipped_lines']} broken lines, or scans without odometry, were left out")
    for what in numbers.get("mended", ()):
        print(f"note: {what}")
    blind = numbers.get("dead_reckoning", {})
    slam_has, wheels_have = (
        numbers | numbers.get("relations", {}),
        blind | blind.get("relations", {}),
    )
    if blind:
        print(f"{'':32}{'SLAM':>10}{'odometry':>10}{'ratio':>8}")
    for key, name, unit in ROWS:
        if key in slam_has and slam_has[key] is not None:
            line = f"  {f'{name} [{unit}]':30}{slam_has[key]:10.3f}"
            if key in wheels_have:
                ratio = wheels_have[key] / slam_has[key] if slam_has[key] else np.inf
                line += f"{wheels_have[key]:10.3f}{ratio:8.1f}"
            print(line)
    if "diverged" in numbers:
        print(f"  {'diverged runs':30}{numbers['diverged']:10d}{blind['diverged']:10d}")
    if numbers.get("nees") is not None:
        print(f"  {'NEES / 3, about 1 if consistent':30}{numbers['nees']:9.3f}")
    print(f"  {'landmarks':30}{numbers['landmarks']:10.0f}")
    print(f"  {'matches a scan':30}{numbers['matches']:10.1f}")
    if numbers.get("closures"):
        print(f"  {'places met again, by scans':30}{numbers['closures']:10d}")
    _tell_seconds(numbers)
    print(f"results: {out}{os.sep}metrics.json, path.png, errors.png, map.geojson, ...")


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
    from jaxslam import plot  # matplotlib takes its time to load

    figure, axis = plot.plan(*plot.extent(plot.outline(occupancy)))
    plot.occupancy(axis, occupancy)
    plot.roads(axis, graph)
    plot.legend(figure)
    figure.savefig(path)


def tell_map(numbers: Numbers, title: str, out: Path) -> None:
    """Print a summary of what `metrics.json` holds of a map."""
    print(f"\n{title}")
    print(f"  {'nodes, of them dead ends':30}{numbers['nodes']:10d}{numbers['dead_ends']:10d}")
    print(f"  {'arcs, rings':30}{numbers['arcs']:10d}{numbers['rings']:10d}")
    print(f"  {'length of the arcs [m]':30}{numbers['length_m']:10.1f}")
    if numbers["arcs"]:
        print(f"  {'smallest clearance [m]':30}{numbers['narrowest_m']:10.2f}")
    print(f"  {'reached, left out [m^2]':30}{numbers['reached_m2']:10.1f}", end="")
    print(f"{numbers['left_out_m2']:10.1f}")
    print(f"  {'seconds':30}{numbers['seconds']['run']:10.1f}")
    print(f"results: {out}{os.sep}metrics.json, map.png, map.geojson, map.graphml")


def _tell_seconds(numbers: Numbers) -> None:
    seconds = numbers["seconds"]
    print(f"  {'seconds':30}{seconds['run']:10.1f}, and {seconds['compile']:.1f} to compile")


def draw_history(path: Path, found: Fit) -> None:
    """Draw how a fit went."""
    from jaxslam import plot  # matplotlib takes its time to load

    figure, axes = plot.canvas(11.0, 4.0, 1, 2)
    plot.losses(axes[0, 0], found.loss, found.heldout, found.best)
    values = [np.asarray(x).reshape(len(found.loss), -1) for x in jax.tree.leaves(found.history)]
    plot.parameters(axes[0, 1], names(found.noise), np.concatenate(values, axis=1), found.best)
    figure.savefig(path)


def tell_tuning(numbers: Numbers, title: str, out: Path) -> None:
    """Print a summary of what `metrics.json` holds of a fit."""
    before = numbers["before"]
    print(f"\n{title}; {numbers['evaluations']} evaluations, judged on {numbers['judged_on']}")
    print(f"  {'':30}{'before':>12}{'after':>12}")
    rows = {"loss": "loss", "position_rmse_m": "position RMSE [m]", "nees": "NEES / dof"}
    rows |= {"heading_rmse_deg": "heading RMSE [deg]", "diverged": "runs diverged"}
    for key, name in rows.items():
        if numbers.get(key) is not None and before.get(key) is not None:
            print(f"  {name:30}{before[key]:12.4g}{numbers[key]:12.4g}")
    sure = numbers["standard_errors"] or {}
    if sure:
        print(f"  {'noise':30}{'':24}{'standard error':>18}")
    old, new = (
        np.concatenate([np.ravel(x) for x in jax.tree.leaves(of["noise"])])
        for of in (before, numbers)
    )
    for name, *values in zip(names(numbers["noise"]), old, new, strict=True):
        error = sure.get(name, np.nan)
        known = "" if np.isnan(error) else "unknown" if np.isinf(error) else f"{error:.0%}"
        print(f"  {name:30}{values[0]:12.4g}{values[1]:12.4g}{known:>18}".rstrip())
    for warning in numbers["warnings"]:
        print(f"warning: {warning}")
    _tell_seconds(numbers)
    print(f"results: {out}{os.sep}noise.json, metrics.json, history.png")
