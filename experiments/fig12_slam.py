"""From S to F and back: the robot steers by its own estimate, home on its own map (Figs. 11-12).

Outbound, the robot follows waypoints from S to F and localises itself by the landmarks that it
finds. Its map then holds nodes and arcs; the path home is the shortest route over them. The robot
gets nothing but the simulated scans and encoder readings: it never knows its true pose.
"""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from experiments import common
from jaxslam.core import se2
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.measurement import Measurement
from jaxslam.core.se2 import compose
from jaxslam.core.types import JUNCTION, Array, Key
from jaxslam.evaluation import summary
from jaxslam.evaluation.consistency import pose_error
from jaxslam.filtering import slam_filter
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.frontend import extract
from jaxslam.mapping import arc_table, graph_arcs, routes, topological_map
from jaxslam.mapping.arc_table import ArcTable
from jaxslam.pipeline.config import Config
from jaxslam.simulation import drive_draws, drives, path_following, ray_casting
from jaxslam.simulation.robot import Robot, true_increment
from jaxslam.simulation.worlds import World

POINTS = 2000  # of a path, padded at its beginning
MAX_SCANS = 380  # of a leg
CONFIG = Config()
MAP_KEYS = {  # of the JSON file, where they differ from the fields of TopologicalMap
    "arc_ends": "pairs",
    "arc_length": "length",
    "arc_lines": "lines",
    "frontier_node": "frontier_of",
}


def padded(path: np.ndarray) -> tuple[Array, Array]:
    """A path (N, 2) padded at its beginning to (POINTS, 2), and the index where it begins."""
    spare = POINTS - len(path)
    whole = np.concatenate([np.repeat(path[:1], spare, 0), path])
    return jnp.asarray(whole, float), jnp.asarray(spare, jnp.int32)


@partial(jax.jit, static_argnames="robot")
def leg(
    key: Key,
    robot: Robot,
    params: NoiseParams,
    world: World,
    path: Array,
    begin: Array,
    truth: Array,
    belief: Belief,
    arcs: ArcTable,
) -> tuple[Array, Belief, ArcTable, Array, Array, StepInfo]:
    """Scan once, then follow `path` by the belief, from a true pose (3,).

    Args:
        key: Of the noise.
        robot: The robot.
        params: Q and R that the filter assumes.
        world: The world.
        path: (POINTS, 2) as of `padded`.
        begin: Index of its first point.
        truth: (3,) true pose.
        belief: Of the filter.
        arcs: Of the map.

    Returns:
        True pose, belief and arcs at the end; true poses, commanded increments and filter
        diagnostics of all scans.
    """
    lidar = CONFIG.frontend.lidar

    def step(carry: tuple, inputs: tuple[Key, Array]) -> tuple[tuple, tuple]:
        truth, belief, arcs, index = carry
        key, moves = inputs
        encoder_key, scan_key = jax.random.split(key)
        command, index = path_following.pure_pursuit(path, index, belief.pose)
        command = jnp.where(moves, command, 0.0)
        draws = jax.random.normal(encoder_key, (drive_draws.SUBSTEPS, 2), path.dtype)
        truth = compose(truth, true_increment(robot, draws, command))
        scan = ray_casting.add_range_noise(scan_key, lidar, ray_casting.cast(lidar, world, truth))
        features, local_arcs = extract.extract_local_graph(CONFIG.frontend, scan)
        measurement = Measurement(command, features)
        belief, info = slam_filter.step(CONFIG.filter, params, belief, measurement)
        arcs = arc_table.add_scan_arcs(lidar, arcs, info.id, info.pose, local_arcs, scan)
        return (truth, belief, arcs, index), (truth, command, info)

    start = (truth, belief, arcs, begin)
    inputs = jax.random.split(key, MAX_SCANS), jnp.arange(MAX_SCANS) > 0
    (truth, belief, arcs, _), (truths, commands, info) = jax.lax.scan(step, start, inputs)
    return truth, belief, arcs, truths, commands, info


def path_home(graph: TopologicalMap, trajectory: np.ndarray) -> np.ndarray:
    """Shortest path (K, 2) to the start of a trajectory (T, 2), over the largest part of a map.

    Between the map and the ends of the trajectory, only the trajectory itself is known to be free.
    """
    size = len(graph.xy)
    joined = coo_matrix((np.ones(len(graph.arc_ends)), graph.arc_ends.T), shape=(size, size))
    component = connected_components(joined, directed=False)[1]
    largest = component == np.argmax(np.bincount(component))
    circles = np.where(largest, graph.clearance, 0.0)  # nothing is in a circle
    node = np.array([graph_arcs.node_at(xy, graph.xy, circles) for xy in trajectory])
    met = np.flatnonzero(node >= 0)
    route = routes.find_route(graph, node[met[-1]], node[met[0]])
    return np.concatenate([trajectory[: met[-1] - 1 : -1], route.line, trajectory[met[0] :: -1]])


def wall_clearance(walls: np.ndarray, points: np.ndarray) -> float:
    """Smallest distance [m] of points (N, 2) from walls (S, 4)."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    offset = points[:, None] - start
    fraction = np.clip(np.sum(offset * along, -1) / np.sum(along**2, -1), 0.0, 1.0)
    return float(np.linalg.norm(offset - fraction[..., None] * along, axis=-1).min())


def compute(seed: int) -> common.Numbers:
    """Drive out and home: trajectories, estimates, errors, and the map."""
    world, robot, tour, _ = common.drive_in()
    params, walls = NoiseParams.for_simulated_robot(*robot[:2]), np.asarray(world.walls, float)
    out_key, home_key = jax.random.split(jax.random.key(seed))
    first = drives.start_pose(tour)
    belief = init(CONFIG.filter, first)
    truth, legs = first, []
    arcs = arc_table.empty_arcs(capacity=2 * CONFIG.filter.max_landmarks)
    path, dead_reckoned = np.asarray(tour), first
    for name, key in (("out", out_key), ("home", home_key)):
        truth, belief, arcs, *history = leg(
            key, robot, params, world, *padded(path), truth, belief, arcs
        )
        still = np.all(np.asarray(history[1]) == 0.0, axis=1)
        count = 1 + int(np.argmax(still[1:])) if still[1:].any() else MAX_SCANS  # at the path's end
        truths, commands, info = jax.tree.map(lambda x, n=count: x[:n], tuple(history))
        odometry = se2.dead_reckoning(dead_reckoned, commands)
        error = np.asarray(pose_error(info.pose, truths))
        legs.append(
            {
                "leg": name,
                "path": path,
                "truth": truths,
                "estimate": info.pose,
                "odometry": odometry,
                "scans": count,
                "length_m": float(np.linalg.norm(np.diff(truths[:, :2], axis=0), axis=1).sum()),
                **summary.rmse_of(error),
                "final_error_m": float(np.hypot(*error[-1, :2])),
                "from_goal_m": float(np.hypot(*(np.asarray(truths)[-1, :2] - path[-1]))),
                "odometry_final_error_m": float(np.hypot(*(odometry - truths)[-1, :2])),
                "wall_clearance_m": wall_clearance(walls, np.asarray(truths)[:, :2]),
            }
        )
        poses = np.concatenate([np.asarray(one["estimate"]) for one in legs])
        graph = topological_map.build_map(
            belief, arcs, poses, confirm_count=CONFIG.filter.confirm_count
        )
        if name == "out":
            path = path_following.densify(path_home(graph, poses[:, :2]))
        dead_reckoned = odometry[-1]
    return {"seed": seed, "legs": legs, "map": map_numbers(graph), "walls": walls}


def map_numbers(graph: TopologicalMap) -> common.Numbers:
    """The fields of a map, as the JSON file has always called them."""
    return {MAP_KEYS.get(name, name): value for name, value in graph._asdict().items()}


def draw(numbers: common.Numbers, path: Path) -> None:
    """The world, both legs, and the map."""
    figure, axes = common.canvas(9, 7.2, 1, 1)
    axis = axes[0, 0]
    for x1, y1, x2, y2 in numbers["walls"]:
        axis.plot([x1, x2], [y1, y2], color=common.BLACK, linewidth=1)
    graph = {key: np.array(numbers["map"][key]) for key in ("xy", "kind")}
    for k, line in enumerate(numbers["map"]["lines"]):
        label = "arcs of the map" if k == 0 else None
        axis.plot(*np.array(line).T, color=common.SKY, linewidth=1.2, label=label)
    for k, line in enumerate(numbers["map"]["frontiers"]):
        axis.plot(
            *np.array(line).T,
            color=common.PINK,
            linewidth=0.8,
            marker="x",
            markevery=[-1],
            label="open frontiers" if k == 0 else None,
        )
    for one, colour in zip(numbers["legs"], (common.RED, common.BLUE), strict=True):
        estimate, truth = np.array(one["estimate"]), np.array(one["truth"])
        label = f"estimate, {one['leg']}"
        axis.plot(*estimate[:, :2].T, color=colour, linewidth=1.6, label=label)
        label = "true path" if one["leg"] == "home" else None
        axis.plot(*truth[:, :2].T, color=common.GREEN, linestyle=":", linewidth=2, label=label)
    nodes = graph["kind"] == JUNCTION
    axis.plot(*graph["xy"][nodes].T, "o", color=common.RED, markersize=5, label="nodes")
    axis.plot(*graph["xy"][~nodes].T, "s", color=common.PINK, fillstyle="none", label="corners")
    odometry = np.concatenate([np.array(one["odometry"]) for one in numbers["legs"]])
    axis.plot(*odometry[:, :2].T, color=common.ORANGE, linewidth=0.8, label="dead reckoning")
    first, last = numbers["legs"][0]["truth"][0], numbers["legs"][0]["truth"][-1]
    for name, pose in (("S", first), ("F", last)):
        axis.annotate(name, pose[:2], fontsize=14, fontweight="bold", color=common.BLACK)
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axis.set(xlim=(-1, 21.5), ylim=(-1.5, 16.5))
    figure.legend(loc="outside lower center", ncols=4)
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    args = common.parse(__doc__, argv)
    numbers = compute(args.seed)
    common.save(args.out, "fig12_slam", numbers, draw)
    for one in numbers["legs"]:
        print(
            f"{one['leg']:5} {one['length_m']:.1f} m, {one['scans']} scans: position RMSE"
            f" {one['position_rmse_m']:.3f} m, heading {one['heading_rmse_deg']:.2f} deg, ends"
            f" {one['from_goal_m']:.2f} m from its goal, {one['wall_clearance_m']:.2f} m clear"
        )


if __name__ == "__main__":
    main()
