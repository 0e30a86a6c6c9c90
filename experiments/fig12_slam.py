"""From S to F and back: the robot steers by its own estimate, home on its own map (Figs. 11-12).

On the way out the robot follows way points from S to F, localised by the landmarks it finds. Its
map then holds nodes and arcs; the way home is the shortest route over them. Nothing but the
simulated scans and encoder readings reaches the robot: it never knows its true pose.
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
from jaxslam.core.types import JUNCTION
from jaxslam.evaluation import summary
from jaxslam.evaluation.consistency import pose_error
from jaxslam.filtering import config, slam_filter
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract
from jaxslam.mapping import arc_table, graph_arcs, routes, topological_map
from jaxslam.pipeline.config import Config
from jaxslam.simulation import drives, path_following, ray_casting
from jaxslam.simulation.robot import Robot, true_increment

POINTS = 2000  # of a path, filled up with its end
STEPS = 380  # scans of a leg at most
CONFIG = Config()


def padded(path: np.ndarray) -> tuple[jnp.ndarray, jnp.ndarray]:
    """A path (N, 2) filled up at its beginning to (POINTS, 2), and the index where it begins."""
    spare = POINTS - len(path)
    whole = np.concatenate([np.repeat(path[:1], spare, 0), path])
    return jnp.asarray(whole, float), jnp.asarray(spare, jnp.int32)


@partial(jax.jit, static_argnames="robot")
def leg(key, robot: Robot, place, noise: NoiseParams, path, begin, truth, belief, arcs):
    """Look around, then follow `path` by the belief, from a true pose (3,)."""

    def step(now, given):
        truth, belief, arcs, at = now
        key, moves = given
        roll_key, scan_key = jax.random.split(key)
        told, at = path_following.pure_pursuit(path, at, belief.pose)
        told = jnp.where(moves, told, 0.0)
        draws = jax.random.normal(roll_key, (drives.SUBSTEPS, 2), path.dtype)
        truth = compose(truth, true_increment(robot, draws, told))
        scan = ray_casting.add_range_noise(
            scan_key, CONFIG.frontend.lidar, ray_casting.cast(CONFIG.frontend.lidar, place, truth)
        )
        seen, links = extract.extract_local_graph(CONFIG.frontend, scan)
        belief, info = slam_filter.step(CONFIG.filter, noise, belief, Measurement(told, seen))
        arcs = arc_table.add_scan_arcs(CONFIG.frontend.lidar, arcs, info.id, info.pose, links, scan)
        return (truth, belief, arcs, at), (truth, told, info)

    start = (truth, belief, arcs, begin)
    each = jax.random.split(key, STEPS), jnp.arange(STEPS) > 0
    (truth, belief, arcs, _), (truths, told, info) = jax.lax.scan(step, start, each)
    return truth, belief, arcs, truths, told, info


def way_home(graph: TopologicalMap, trail: np.ndarray) -> np.ndarray:
    """Shortest way (K, 2) back to where a trail (T, 2) began, over the largest part of the map.

    What lies between the map and the ends of the trail is known to be free along the trail alone.
    """
    size = len(graph.xy)
    joined = coo_matrix((np.ones(len(graph.arc_ends)), graph.arc_ends.T), shape=(size, size))
    part = connected_components(joined, directed=False)[1]
    largest = part == np.argmax(np.bincount(part))
    circles = np.where(largest, graph.clearance, 0.0)  # nothing is in a circle
    at = np.array([graph_arcs.node_at(place, graph.xy, circles) for place in trail])
    met = np.flatnonzero(at >= 0)
    way = routes.find_route(graph, at[met[-1]], at[met[0]])
    return np.concatenate([trail[: met[-1] - 1 : -1], way.line, trail[met[0] :: -1]])


def clearance(walls: np.ndarray, places: np.ndarray) -> float:
    """Smallest distance [m] of places (N, 2) from walls (S, 4)."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    offset = places[:, None] - start
    part = np.clip(np.sum(offset * along, -1) / np.sum(along**2, -1), 0.0, 1.0)
    return float(np.linalg.norm(offset - part[..., None] * along, axis=-1).min())


def compute(seed: int) -> common.Numbers:
    """Drive out and home; what happened, what the robot believed, and its map."""
    place, robot, tour, _ = common.scene()
    noise, walls = NoiseParams.for_simulated_robot(*robot), np.asarray(place.max_walls, float)
    out_key, home_key = jax.random.split(jax.random.key(seed))
    first = drives.start_pose(tour)
    belief = config.init(CONFIG.filter, first)
    truth, legs = first, []
    arcs = arc_table.empty_arcs(capacity=2 * CONFIG.filter.max_landmarks)
    path, blind = np.asarray(tour), first
    for name, key in (("out", out_key), ("home", home_key)):
        truth, belief, arcs, truths, told, info = leg(
            key, robot, place, noise, *padded(path), truth, belief, arcs
        )
        still = np.all(np.asarray(told) == 0.0, axis=1)
        moved = 1 + int(np.argmax(still[1:])) if still[1:].any() else STEPS  # at the path's end
        cut = lambda tree: jax.tree.map(lambda x: x[:moved], tree)  # noqa: B023
        truths, told, info = cut((truths, told, info))
        odometry = se2.dead_reckoning(blind, told)
        error = np.asarray(pose_error(info.pose, truths))
        legs.append(
            {
                "leg": name,
                "path": path,
                "truth": truths,
                "estimate": info.pose,
                "odometry": odometry,
                "scans": moved,
                "length_m": float(np.linalg.norm(np.diff(truths[:, :2], axis=0), axis=1).sum()),
                **summary.rmse_of(error),
                "final_error_m": float(np.hypot(*error[-1, :2])),
                "from_goal_m": float(np.hypot(*(np.asarray(truths)[-1, :2] - path[-1]))),
                "odometry_final_error_m": float(np.hypot(*(odometry - truths)[-1, :2])),
                "wall_clearance_m": clearance(walls, np.asarray(truths)[:, :2]),
            }
        )
        poses = np.concatenate([np.asarray(one["estimate"]) for one in legs])
        graph = topological_map.build_map(
            belief, arcs, poses, confirm_count=CONFIG.filter.confirm_count
        )
        if name == "out":
            path = path_following.densify(way_home(graph, poses[:, :2]))
        blind = odometry[-1]
    return {"seed": seed, "legs": legs, "map": graph._asdict(), "walls": walls}


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
        label = "ways into what was not seen" if k == 0 else None
        style = {"color": common.PINK, "linewidth": 0.8, "marker": "x", "markevery": [-1]}
        axis.plot(*np.array(line).T, label=label, **style)
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
    given = common.parse(__doc__, argv)
    numbers = compute(given.seed)
    common.save(given.out, "fig12_slam", numbers, draw)
    for one in numbers["legs"]:
        print(
            f"{one['leg']:5} {one['length_m']:.1f} m, {one['scans']} scans: position RMSE"
            f" {one['position_rmse_m']:.3f} m, heading {one['heading_rmse_deg']:.2f} deg, ends"
            f" {one['from_goal_m']:.2f} m from its goal, {one['wall_clearance_m']:.2f} m clear"
        )


if __name__ == "__main__":
    main()
