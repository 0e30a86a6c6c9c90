"""Figs. 8 and 9 of the paper: the topological map of a room, grown scan by scan.

The robot scans the 6 m x 5 m room from ten poses, moves from one to the next by its noisy odometry,
and adds the local map of each scan to the global one. The map at the end is compared with the
Voronoi graph of the full room, which is computed from its walls, without a robot. So is the diagram
of all ten scans in one grid (`grid` in the JSON file), with the same landmarks as nodes; it does
not depend on which junctions single scans show.

Ten scans see most junctions once or twice. So here a landmark counts from its first observation
(`confirm_count=1`) and is trusted sooner (`FeatureSpec`), which leaves it up to 6 cm off; the
filter assumes so (`RANGE_STD`, `BEARING_STD`). Two junctions of the room are 0.25 m apart, so
`min_separation` is less than that. The ten poses were chosen for what can be seen from them: the
JSON file also has the results for other draws of the noise, and for poses that are slightly moved.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linear_sum_assignment
from tqdm import tqdm

from experiments.common import Numbers, parse, save
from experiments.fig09_picture import draw
from experiments.room_graph import reference
from jaxslam.core import polylines
from jaxslam.core.features import Features
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Scan
from jaxslam.core.se2 import relative, transform
from jaxslam.core.types import JUNCTION, Array, Key
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import FilterConfig, init
from jaxslam.filtering.data_association import AssociationSpec
from jaxslam.filtering.motion_model import odometry_cov, wheel_coefficients
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract, voronoi
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.features import FeatureSpec
from jaxslam.frontend.grid import centres
from jaxslam.frontend.local_graph import LocalArcs
from jaxslam.mapping import arc_table, topological_map
from jaxslam.mapping.global_map import build_global_map
from jaxslam.mapping.hidden_walls import with_hidden_walls
from jaxslam.mapping.occupancy import occupancy_map
from jaxslam.pipeline.config import Config
from jaxslam.simulation import worlds
from jaxslam.simulation.ray_casting import add_range_noise, cast
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World

WORLD = "fig07"
GRID_CELL = 0.025  # [m]
CONFIG = Config(
    frontend=FrontendConfig(features=FeatureSpec(min_seen_fraction=0.5, max_hidden_depth=0.3)),
    filter=FilterConfig(confirm_count=1, association=AssociationSpec(min_separation=0.15)),
)
RANGE_STD, BEARING_STD = 0.02, 0.01  # [m], [rad] of nodes, beyond their own
NEAR = 0.1  # [m] a node of the map this close to a junction is that junction
SHIFT = (0.05, 0.05, np.radians(3.0))  # [m, m, rad] standard deviation of poses that are moved


@jax.jit
def scans_from(key: Key, poses: Array, walls: Array) -> Scan:
    """Noisy scans [T] of the walls (S, 4) from poses (T, 3)."""
    lidar = CONFIG.frontend.lidar

    def noisy_scan(key: Key, pose: Array) -> Scan:
        return add_range_noise(key, lidar, cast(lidar, World(walls), pose))

    return jax.vmap(noisy_scan)(jax.random.split(key, poses.shape[0]), poses)


def noisy_odometry(poses: np.ndarray, robot: Robot, seed: int) -> np.ndarray:
    """Odometry increments (T, 3) of the encoders between successive poses (T, 3)."""
    increments, random = [np.zeros(3)], np.random.default_rng(seed)
    for a, b in zip(jnp.asarray(poses[:-1], float), jnp.asarray(poses[1:], float), strict=True):
        exact = relative(a, b)
        cov = np.asarray(odometry_cov(wheel_coefficients(*robot[:2]), exact), np.float64)
        increments.append(random.multivariate_normal(np.asarray(exact), (cov + cov.T) / 2))
    return np.array(increments)


step = jax.jit(slam_filter.step, static_argnums=0)
add_scan_arcs = jax.jit(arc_table.add_scan_arcs, static_argnames="lidar")


@jax.jit
def branch_cells(scans: Scan) -> Array:
    """Cells [T] (H, W) bool of the branches of each local diagram."""

    def one(scan: Scan) -> Array:
        _, diagram, sources = extract.extract_diagram(CONFIG.frontend, scan)
        return voronoi.branch_cells(diagram, sources)

    return jax.lax.map(one, scans)


def explore(
    scan_poses: np.ndarray, walls: np.ndarray, seed: int
) -> tuple[list[Numbers], Numbers, np.ndarray, tuple[Scan, Features, LocalArcs]]:
    """Scan from each pose, and add each local map to the global one at once.

    Returns:
        The global map after each scan, that of all scans in one grid, the estimated poses (T, 3),
        and the scans with their local maps.
    """
    robot = Robot()
    poses = jnp.asarray(scan_poses, float)
    params = NoiseParams.for_simulated_robot(*robot[:2])._replace(
        range_std=jnp.asarray(RANGE_STD, float), bearing_std=jnp.asarray(BEARING_STD, float)
    )
    scans = scans_from(jax.random.key(seed), poses, jnp.asarray(walls, float))
    increments = jnp.asarray(noisy_odometry(scan_poses, robot, seed), float)
    features, local_arcs = extract.extract_local_graphs(CONFIG.frontend, scans)
    belief = init(CONFIG.filter, poses[0])
    arcs = arc_table.empty_arcs(capacity=2 * CONFIG.filter.max_landmarks)
    maps, estimates = [], []
    for t in range(len(scan_poses)):
        own, own_arcs, scan = jax.tree.map(lambda x, t=t: x[t], (features, local_arcs, scans))
        belief, info = step(CONFIG.filter, params, belief, Measurement(increments[t], own))
        arcs = add_scan_arcs(CONFIG.frontend.lidar, arcs, info.id, info.pose, own_arcs, scan)
        estimates.append(np.asarray(info.pose))
        graph = topological_map.build_map(
            belief,
            arcs,
            np.array(estimates),
            confirm_count=CONFIG.filter.confirm_count,
            min_separation=CONFIG.filter.association.min_separation,
        )
        maps.append(plain_map(graph))
    whole = grid_map(graph, np.array(estimates, np.float64), scans)
    return maps, whole, np.array(estimates), (scans, features, local_arcs)


def plain_map(graph: TopologicalMap) -> Numbers:
    """The nodes and arcs of a map, without its corners."""
    nodes = np.flatnonzero(graph.kind == JUNCTION)
    rank = {int(n): k for k, n in enumerate(nodes)}
    return {
        "id": graph.id[nodes],
        "xy": graph.xy[nodes].round(4),
        "clearance_m": graph.clearance[nodes].round(3),
        "arcs": [[rank[a], rank[b]] for a, b in graph.arc_ends.tolist()],
        "lines": [line.round(3) for line in graph.arc_lines],
        "driven_only": np.isnan(graph.arc_clearance),
        "length_m": graph.arc_length.round(3),
        "arc_clearance_m": graph.arc_clearance.round(3),
        "frontiers": [line.round(3) for line in graph.frontiers],
    }


def local_views(
    estimates: np.ndarray, scans: Scan, features: Features, local_arcs: LocalArcs
) -> list[Numbers]:
    """What each scan adds, in the map frame: branch cells, junctions and arcs between them."""
    cells, views = np.asarray(branch_cells(scans)), []
    centre = np.asarray(centres(CONFIG.frontend.grid))
    for t, pose in enumerate(estimates):
        keep = np.asarray(features.valid[t] & (features.kind[t] == JUNCTION))
        complete = local_arcs.valid[t] & (local_arcs.pair[t, :, 1] >= 0)
        views.append(
            {
                "branches": _in_map(pose, centre[cells[t]]).round(2),
                "nodes": _in_map(pose, features.xy[t])[keep].round(3),
                "arcs": int(np.sum(complete)),
            }
        )
    return views


def _in_map(pose: np.ndarray, points: Any) -> np.ndarray:
    """Points (N, 2) of the base_link frame at `pose` (3,), in the map frame."""
    return np.asarray(transform(jnp.asarray(pose), jnp.asarray(points)))


def grid_map(merged: TopologicalMap, estimates: np.ndarray, scans: Scan) -> Numbers:
    """The map of all scans [T] in one grid at their estimated poses (T, 3)."""
    lidar = CONFIG.frontend.lidar
    grid = occupancy_map(lidar, estimates, scans, resolution=GRID_CELL)
    grid = with_hidden_walls(grid, lidar, estimates, scans)
    separate = np.insert(estimates, np.arange(1, len(estimates)), np.nan, axis=0)
    found = build_global_map(grid, separate, merged, 10**6, with_corner_junctions=True)
    return plain_map(found.graph)


def compare(found: Numbers, true: Numbers) -> Numbers:
    """Compare nodes and arcs of a map with junctions and branches of the full room."""
    junctions = np.array([j["xy"] for j in true["junctions"]])
    xy = np.asarray(found["xy"]).reshape(-1, 2)
    away = np.linalg.norm(xy[:, None] - junctions[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(away, 2 * NEAR))
    match = {int(n): int(j) for n, j in zip(rows, columns, strict=True) if away[n, j] <= NEAR}
    errors = [away[n, j] for n, j in match.items()]
    named = [tuple(sorted(match.get(n, -1) for n in pair)) for pair in found["arcs"]]
    wanted = {tuple(pair) for pair in true["arcs"]}
    seen = {p for p, only in zip(named, found["driven_only"], strict=True) if not only}
    lines = dict(zip(map(tuple, true["arcs"]), map(np.array, true["lines"]), strict=True))
    off = [
        np.max(polylines.project(np.array(line), lines[name])[0])
        for name, line in zip(named, found["lines"], strict=True)
        if name in wanted & seen
    ]
    # Two arcs where the room has one: the second is as wrong as one where it has none.
    wrong = [
        pair
        for k, (pair, name) in enumerate(zip(found["arcs"], named, strict=True))
        if name not in wanted or name in named[:k]
    ]
    return {
        "junctions": len(junctions),
        "nodes_found": len(match),
        "nodes_missed": sorted(set(range(len(junctions))) - set(match.values())),
        "nodes_spurious": sorted(set(range(len(xy))) - set(match)),
        "position_error_m": middle_and_worst(errors),
        "worst_node_error_m": round(float(max(errors, default=np.inf)), 4),
        "arcs": len(wanted),
        "arcs_found": len(wanted & set(named)),
        "arcs_found_by_driving_only": len((wanted & set(named)) - seen),
        "arc_off_branch_m": middle_and_worst(off),
        "arcs_missed": sorted(wanted - set(named)),
        "arcs_spurious": wrong,
        "missing_arcs": len(wanted - set(named)),
        "extra_arcs": len(wrong),
        "junction_of_node": [match.get(n, -1) for n in range(len(xy))],
    }


def middle_and_worst(errors: list[float]) -> Numbers:
    """Median and largest of some errors [m], none of none."""
    if not errors:
        return {"median": None, "max": None}
    return {"median": round(float(np.median(errors)), 4), "max": round(float(max(errors)), 4)}


def repeat(
    scan_poses: np.ndarray, walls: np.ndarray, true: Numbers, seeds: range, shift: np.ndarray
) -> Numbers:
    """Means of the comparison over other draws of the noise, the poses moved by `shift` (3,)."""
    merged, grid = [], []
    for seed in tqdm(seeds, unit="map", disable=len(seeds) < 2):
        moved = scan_poses + np.random.default_rng(seed).normal(size=scan_poses.shape) * shift
        maps, whole, *_ = explore(moved, walls, seed)
        merged.append(compare(maps[-1], true))
        grid.append(compare(whole, true))
    return means(merged, true) | {"grid": means(grid, true)}


def means(results: list[Numbers], true: Numbers) -> Numbers:
    """Means of comparisons of several maps with the full room."""
    counts = {
        key: [len(r[key]) if isinstance(r[key], list) else r[key] for r in results]
        for key in ("nodes_found", "nodes_spurious", "arcs_found", "arcs_spurious")
    }
    worst = [r["position_error_m"]["max"] for r in results if r["nodes_found"]]
    whole = [n == len(true["junctions"]) for n in counts["nodes_found"]]
    return {
        "runs": len(results),
        **{f"{key}_mean": float(np.mean(count)) for key, count in counts.items()},
        "runs_with_all_nodes": int(np.sum(whole)),
        "runs_equal": sum(equal(r) for r in results),
        "extra_arcs_fraction": float(
            np.sum(counts["arcs_spurious"]) / (len(true["arcs"]) * len(results))
        ),
        "position_error_max_m": max(worst, default=None),
    }


def equal(result: Numbers) -> bool:
    """Whether a map has the nodes and arcs of the full room, and no others."""
    keys = ("nodes_missed", "nodes_spurious", "arcs_missed", "arcs_spurious")
    return not any(result[key] for key in keys)


def compute(seed: int, num_trials: int) -> Numbers:
    """The maps scan by scan, the reference, and how they compare."""
    scan_poses, walls = worlds.scan_poses(WORLD), np.asarray(worlds.named(WORLD).walls)
    true = reference(walls)
    maps, whole, estimates, local = explore(scan_poses, walls, seed)
    result, on_grid = compare(maps[-1], true), compare(whole, true)
    others = range(seed + 1, seed + 1 + num_trials)
    return {
        "equals_the_voronoi_graph_of_the_room": equal(result),
        **{key: result[key] for key in ("worst_node_error_m", "extra_arcs", "missing_arcs")},
        "near_m": NEAR,
        "comparison": result,
        "grid": {"equals_the_voronoi_graph_of_the_room": equal(on_grid), "comparison": on_grid}
        | {"map": whole},
        "other_noise": repeat(scan_poses, walls, true, others, np.zeros(3)),
        "places_moved": {"std_m_m_rad": SHIFT}
        | repeat(scan_poses, walls, true, others, np.array(SHIFT)),
        "nodes_in_map": [len(m["xy"]) for m in maps],
        "arcs_in_map": [len(m["arcs"]) for m in maps],
        "pose_error_m": np.hypot(*(estimates - scan_poses)[:, :2].T).round(4),
        "places": scan_poses,
        "estimates": estimates.round(4),
        "walls": walls,
        "reference": true,
        "maps": maps,
        "local": local_views(estimates, *local),
    }


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    args = parse(__doc__, argv, runs=12)
    save(args.out, "fig09_global", compute(args.seed, args.runs), draw)


if __name__ == "__main__":
    main()
