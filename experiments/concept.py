"""How it works, in one picture: scan, Voronoi diagram, landmarks, filter, topological map.

One simulated drive through the office, by the default configuration. The first three panels show
one scan, the last two the filter in mid-drive and the map at the end.
"""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import common
from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import CORNER, JUNCTION
from jaxslam.filtering import config as filter_config
from jaxslam.filtering.covariance import slot_blocks
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import run_filter
from jaxslam.frontend import extract
from jaxslam.frontend.lidar import beam_ends
from jaxslam.pipeline.config import Config
from jaxslam.simulation import drives, trial_episodes, trials
from jaxslam.simulation.ray_casting import cast
from jaxslam.simulation.worlds import World

SCAN = 160  # number of the scan that is shown
WINDOW = (-0.25, 7.0, -3.5, 3.5)  # [m] of the robot frame
CONFIG = Config()
KINDS = {JUNCTION: "junctions", CORNER: "corners"}


def features_of(scan_config: Config, world: World, pose: np.ndarray) -> tuple[common.Numbers, ...]:
    """Hits, diagram and features of a noise-free scan, robot frame."""
    frontend = scan_config.frontend._replace(grid=common.GRID)
    scan = cast(frontend.lidar, world, jnp.asarray(pose, float))
    found, diagram, sources = jax.jit(partial(extract.extract_diagram, frontend))(scan)
    hits = np.asarray(beam_ends(frontend.lidar, scan))[np.asarray(scan.hit)]
    return hits, common.picture(diagram, np.asarray(sources), WINDOW), _by_kind(found)


def _by_kind(found: Features) -> common.Numbers:
    valid, kind, xy = (np.asarray(x) for x in (found.valid, found.kind, found.xy))
    return {name: xy[valid & (kind == own)] for own, name in KINDS.items()}


def landmarks_after(steps: int, odometry, features, start) -> common.Numbers:
    """Estimated path and confirmed landmarks of the filter after some scans."""
    measurements = Measurement(odometry[:steps], jax.tree.map(lambda x: x[:steps], features))
    params = NoiseParams.for_simulated_robot()
    belief = filter_config.init(CONFIG.filter, start)
    belief, info = run_filter(CONFIG.filter, params, belief, measurements)
    use = np.asarray(filter_config.confirmed(CONFIG.filter, belief))
    own = np.asarray(belief.kind)[use]
    xy, cov = np.asarray(belief.landmark_positions)[use], np.asarray(slot_blocks(belief.map_cov))
    return {
        "path": np.asarray(info.pose)[:, :2],
        "pose": np.asarray(info.pose)[-1],
        **{name: xy[own == kind] for kind, name in KINDS.items()},
        "cov": {name: cov[use][own == kind] for kind, name in KINDS.items()},
    }


def compute(seed: int) -> common.Numbers:
    """One drive: a scan, what is found in it, the filter in mid-drive, the map at the end."""
    world, robot, path, num_scans = common.drive_in()
    params = NoiseParams.for_simulated_robot(*robot[:2])
    truth, result = trials.replay_trial(
        jax.random.key(seed), CONFIG, params, robot, world, path, trial=0, num_scans=num_scans
    )
    key = trial_episodes.trial_keys(jax.random.key(seed), jnp.arange(1))[0]
    odometry = drives.drive(jax.random.split(key)[0], robot, path, num_scans=num_scans)[1]
    hits, diagram, features = features_of(CONFIG, world, np.asarray(truth)[SCAN])
    graph = result.topological_map
    return {
        "seed": seed,
        "walls": np.asarray(world.walls),
        "hits": hits,
        "diagram": diagram,
        "features": features,
        "filter": landmarks_after(SCAN + 1, odometry, result.features, truth[0]),
        "map": {
            "nodes": graph.xy[graph.kind == JUNCTION],
            "arcs": [line.tolist() for line in graph.arc_lines],
            "path": result.poses[:, :2],
        },
    }


def draw(numbers: common.Numbers, path: Path) -> None:
    """Draw the five panels."""
    from matplotlib.collections import LineCollection

    from jaxslam.viz.landmarks import draw_ellipses

    figure, axes = common.canvas(17.0, 3.9, 1, 5)
    (scan, diagram, found, filtered, mapped) = axes[0]
    hits = np.array(numbers["hits"])
    for axis in (scan, diagram, found):
        axis.set(xlim=(WINDOW[3], WINDOW[2]), ylim=WINDOW[:2], aspect="equal")
        axis.set(xlabel="y, to the left [m]")
    scan.plot(hits[:, 1], hits[:, 0], ".", color=common.BLACK, markersize=2)
    scan.plot(0, 0, "^", color=common.RED, markersize=8, clip_on=False)
    scan.set(title="1. scan", ylabel="x, ahead [m]")
    common.draw_picture(diagram, numbers["diagram"])
    diagram.set(title="2. automaton: Voronoi diagram", ylabel="")
    common.draw_picture(found, numbers["diagram"])
    looks = {"junctions": ("o", common.GREEN), "corners": ("s", common.ORANGE)}
    for name, (marker, colour) in looks.items():
        xy = np.array(numbers["features"][name]).reshape(-1, 2)
        found.plot(xy[:, 1], xy[:, 0], marker, color=colour, markeredgecolor="white", label=name)
    found.set(title="3. features", ylabel="")
    found.legend(loc="lower right", fontsize=8)
    walls = np.array(numbers["walls"]).reshape(-1, 2, 2)
    for axis in (filtered, mapped):
        axis.add_collection(LineCollection(walls, colors="#B5B5B5", linewidths=1.0))
        axis.set(aspect="equal", xlabel="x [m]")
        axis.autoscale_view()
    own = numbers["filter"]
    filtered.plot(*np.array(own["path"]).T, color=common.SKY, linewidth=2.5)
    for name, (marker, colour) in looks.items():
        xy = np.array(own[name]).reshape(-1, 2)
        filtered.plot(*xy.T, marker, color=colour, markersize=3)
        draw_ellipses(filtered, xy, np.array(own["cov"][name]).reshape(-1, 2, 2), colour)
    filtered.plot(*own["pose"][:2], "^", color=common.RED, markersize=8)
    filtered.set(title="4. EKF-SLAM: path, landmarks", ylabel="y [m]")
    graph = numbers["map"]
    lines = [np.array(line) for line in graph["arcs"]]
    mapped.add_collection(LineCollection(lines, colors=common.BLUE, linewidths=1.3))
    mapped.plot(*np.array(graph["nodes"]).T, "o", color=common.RED, markersize=4)
    mapped.set(title="5. topological map")
    figure.savefig(path)


def main() -> None:
    """Run the experiment."""
    given = common.parse(__doc__)
    common.save(given.out, "concept", compute(given.seed), draw)


if __name__ == "__main__":
    main()
