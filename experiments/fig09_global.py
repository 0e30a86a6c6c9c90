"""Figs. 8 and 9 of the paper: the topological map of a room, grown scan by scan.

The robot looks at the 6 m x 5 m room from ten places, goes from one to the next by its noisy
odometry, and adds the local map of each scan to the global one. The map at the end is compared
with the Voronoi graph of the full room, which is made from its walls, without a robot.

Ten scans see most junctions once or twice, so that here a landmark counts from its first sighting
(`confirm=1`) and is trusted sooner (`features`), which leaves it up to 6 cm off, as the filter is told
(`RANGE`, `BEARING`); two junctions of the room are 0.25 m apart, so that `apart` is less than that.
The ten places were chosen for what can be seen from them: JSON also says what other draws of the
noise give, and what places do that are moved a little.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linear_sum_assignment

from experiments.common import Numbers, parse, save
from experiments.fig09_picture import draw
from experiments.room_graph import reference
from jaxslam.core import polylines
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.measurement import Measurement
from jaxslam.core.se2 import relative, transform
from jaxslam.core.types import JUNCTION
from jaxslam.filtering import config, slam_filter
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.data_association import AssociationSpec
from jaxslam.filtering.motion_model import odometry_cov, wheel_coefficients
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract, voronoi
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.features import FeatureSpec
from jaxslam.frontend.grid import centres
from jaxslam.mapping import arc_table, topological_map
from jaxslam.pipeline.config import Config
from jaxslam.simulation import worlds
from jaxslam.simulation.ray_casting import add_range_noise, cast
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World

WORLD = "fig07"
CONFIG = Config(
    filter=FilterConfig(
        confirm_count=1,
        association=AssociationSpec(min_separation=0.15),
    ),
    frontend=FrontendConfig(
        features=FeatureSpec(min_seen_fraction=0.5, max_hidden_depth=0.3),
    ),
)
RANGE, BEARING = 0.02, 0.01  # [m], [rad] standard deviation of nodes beyond their own
NEAR = 0.1  # [m] a node of the map this close to a junction is that junction
SHIFT = (0.05, 0.05, 0.05)  # [m, m, rad] standard deviation of places that are moved


@jax.jit
def scans_from(poses: jax.Array, walls: jax.Array, key: jax.Array):
    """Noisy scans [T] of the walls (S, 4) from poses (T, 3)."""
    look = lambda pose, own: add_range_noise(
        own, CONFIG.frontend.lidar, cast(CONFIG.frontend.lidar, World(walls), pose)
    )
    return jax.vmap(look)(poses, jax.random.split(key, poses.shape[0]))


def odometry(places: np.ndarray, robot: Robot, seed: int) -> np.ndarray:
    """What the encoders say (T, 3) of the way between successive places (T, 3)."""
    told, random = [np.zeros(3)], np.random.default_rng(seed)
    for a, b in zip(jnp.asarray(places[:-1], float), jnp.asarray(places[1:], float), strict=True):
        motion = relative(a, b)
        cov = np.asarray(odometry_cov(wheel_coefficients(*robot), motion), np.float64)
        told.append(random.multivariate_normal(np.asarray(motion), (cov + cov.T) / 2))
    return np.array(told)


step = jax.jit(slam_filter.step, static_argnums=0)
add = jax.jit(arc_table.add_scan_arcs, static_argnames="lidar")


@jax.jit
def branch_cells(scans):
    """Cells [T] (H, W) bool of the branches of each local diagram."""

    def one(scan):
        _, diagram, sources = extract.extract_diagram(CONFIG.frontend, scan)
        return voronoi.branch_cells(diagram, sources)

    return jax.lax.map(one, scans)


def explore(
    places: np.ndarray, walls: np.ndarray, seed: int
) -> tuple[list[Numbers], np.ndarray, tuple]:
    """Scan from each place, and add each local map to the global one at once.

    Returns:
        The global map after each scan, the estimated poses (T, 3), and the scans with their local
        maps.
    """
    robot = Robot()
    poses = jnp.asarray(places, float)
    noise = NoiseParams.for_simulated_robot(*robot)._replace(
        range_std=jnp.asarray(RANGE, float), bearing_std=jnp.asarray(BEARING, float)
    )
    scans = scans_from(poses, jnp.asarray(walls, float), jax.random.key(seed))
    told = jnp.asarray(odometry(places, robot, seed), float)
    seen, links = extract.extract_local_graphs(CONFIG.frontend, scans)
    belief, arcs = (
        config.init(CONFIG.filter, poses[0]),
        arc_table.empty_arcs(capacity=2 * CONFIG.filter.max_landmarks),
    )
    maps, way = [], []
    for t in range(len(places)):
        nodes, branch, scan = jax.tree.map(lambda x, t=t: x[t], (seen, links, scans))
        belief, info = step(CONFIG, noise, belief, Measurement(told[t], nodes))
        arcs = add(arcs, info.id, info.pose, branch, scan, lidar=CONFIG.frontend.lidar)
        way.append(np.asarray(info.pose))
        graph = topological_map.build_map(
            belief,
            arcs,
            np.array(way),
            confirm_count=CONFIG.filter.confirm_count,
            min_separation=CONFIG.filter.association.min_separation,
        )
        maps.append(plain_map(graph))
    return maps, np.array(way), (scans, seen, links)


def plain_map(graph: TopologicalMap) -> Numbers:
    """Nodes and arcs of a map, without its corners."""
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


def local_views(way: np.ndarray, scans, seen, links) -> list[Numbers]:
    """What each scan adds, in the map's frame: branch cells, junctions and arcs between them."""
    cells, views = np.asarray(branch_cells(scans)), []
    middle = np.asarray(centres(CONFIG.frontend.grid))
    for t, pose in enumerate(way):
        place = lambda xy, pose=pose: np.asarray(transform(jnp.asarray(pose), jnp.asarray(xy)))
        keep = np.asarray(seen.valid[t] & (seen.kind[t] == JUNCTION))
        views.append(
            {
                "branches": place(middle[cells[t]]).round(2),
                "nodes": place(seen.xy[t])[keep].round(3),
                "arcs": int(np.sum(links.valid[t] & (links.pair[t, :, 1] >= 0))),
            }
        )
    return views


def compare(found: Numbers, true: Numbers) -> Numbers:
    """Nodes and arcs of a map against junctions and branches of the full room."""
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


def repeat(places: np.ndarray, walls: np.ndarray, true: Numbers, seeds: range, shift) -> Numbers:
    """Means of the comparison over other draws of the noise, the places moved by `shift` (3,)."""
    results = []
    for seed in seeds:
        moved = places + np.random.default_rng(seed).normal(size=places.shape) * shift
        results.append(compare(explore(moved, walls, seed)[0][-1], true))
    count = lambda key: [len(r[key]) if isinstance(r[key], list) else r[key] for r in results]
    keys = ["nodes_found", "nodes_spurious", "arcs_found", "arcs_spurious"]
    worst = [r["position_error_m"]["max"] for r in results if r["nodes_found"]]
    whole = [n == len(true["junctions"]) for n in count("nodes_found")]
    return {
        "runs": len(results),
        **{f"{key}_mean": float(np.mean(count(key))) for key in keys},
        "runs_with_all_nodes": int(np.sum(whole)),
        "runs_equal": sum(equal(r) for r in results),
        "position_error_max_m": max(worst, default=None),
    }


def equal(result: Numbers) -> bool:
    """Whether a map has the nodes and arcs of the full room, and no others."""
    keys = ("nodes_missed", "nodes_spurious", "arcs_missed", "arcs_spurious")
    return not any(result[key] for key in keys)


def compute(seed: int, runs: int) -> Numbers:
    """The maps scan by scan, the reference, and how they compare."""
    places, walls = worlds.scan_poses(WORLD), np.asarray(worlds.named(WORLD).walls)
    true = reference(walls)
    maps, way, local = explore(places, walls, seed)
    result = compare(maps[-1], true)
    others = range(seed + 1, seed + 1 + runs)
    return {
        "equals_the_voronoi_graph_of_the_room": equal(result),
        **{key: result[key] for key in ("worst_node_error_m", "extra_arcs", "missing_arcs")},
        "near_m": NEAR,
        "comparison": result,
        "other_noise": repeat(places, walls, true, others, np.zeros(3)),
        "places_moved": {"std_m_m_rad": SHIFT}
        | repeat(places, walls, true, others, np.array(SHIFT)),
        "nodes_in_map": [len(m["xy"]) for m in maps],
        "arcs_in_map": [len(m["arcs"]) for m in maps],
        "pose_error_m": np.hypot(*(way - places)[:, :2].T).round(4),
        "places": places,
        "estimates": way.round(4),
        "walls": walls,
        "reference": true,
        "maps": maps,
        "local": local_views(way, *local),
    }


def main() -> None:
    """Run the experiment."""
    given = parse(__doc__, runs=12)
    numbers = compute(given.seed, given.frontend.segments)
    save(given.out, "fig09_global", numbers, draw)


if __name__ == "__main__":
    main()
