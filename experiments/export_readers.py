"""The files of a `jaxslam run` in the readers they are for: what of them arrives.

graph.g2o in GTSAM: factors read, and the optimum beside that of our smoother without a robust
kernel, both without landmarks. map.graphml in igraph: nodes and arcs that have the position, ends
and length that map.geojson gives them. map.lif.json in vdma-lif, map.rmf.yaml in PyYAML: points and
edges. Needs the extra [test].
"""

import json
from pathlib import Path

import jax
import numpy as np

from experiments import common
from experiments.common import Numbers
from jaxslam.io.errors import InputError
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.smoothing import SmoothingProblem, smooth_log
from jaxslam.smoothing.problem import LandmarkPrior

NAME = "export_readers"
START_STD = 1e-6  # [m, m, rad] of the pose that is held


def optimum_of_gtsam(path: Path) -> tuple[int, np.ndarray, np.ndarray]:
    """Factors that GTSAM reads, poses (T, 3) of the file, and their optimum."""
    import gtsam

    factors, read = gtsam.readG2o(str(path), False)
    count = factors.size()
    index = range(path.read_text().count("VERTEX_SE2"))
    guess = gtsam.Values()
    for k in index:
        guess.insert(k, read.atPose2(k))
    factors = gtsam.NonlinearFactorGraph(factors)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, START_STD)
    factors.add(gtsam.PriorFactorPose2(0, read.atPose2(0), noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-13)
    best = gtsam.LevenbergMarquardtOptimizer(factors, guess, parameters).optimize()

    def as_array(values) -> np.ndarray:
        poses = [values.atPose2(k) for k in index]
        return np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])

    return count, as_array(guess), as_array(best)


def own_optimum(edges: list[list[str]], poses: np.ndarray) -> np.ndarray:
    """Optimum (T, 3) of EDGE_SE2 lines, by words, from poses (T, 3) of which the first is held."""
    ends = np.array([edge[1:3] for edge in edges], int)
    numbers = np.array([edge[3:] for edge in edges], float)
    information = np.zeros((len(edges), 3, 3))
    information[:, *np.triu_indices(3)] = numbers[:, 3:]
    information += np.triu(information, 1).swapaxes(1, 2)
    c, s = np.cos(numbers[:, 2]), np.sin(numbers[:, 2])
    turn = np.tile(np.eye(3), (len(edges), 1, 1))  # from the second frame to the first
    turn[:, :2, :2] = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    information = turn @ information @ turn.swapaxes(1, 2)
    count = len(poses) - 1
    closures = np.arange(count, len(edges))
    if not (ends[:count] == np.arange(count)[:, None] + [0, 1]).all() or (ends[count:] < 1).any():
        raise InputError("closures of pose 0, or odometry that is not from pose to pose")
    problem = SmoothingProblem(
        start=poses[0],
        odometry=numbers[:count, :3],
        odometry_cov=np.linalg.inv(information[:count]),
        measurement=np.ones((count, 1, 2)),
        measurement_cov=np.tile(np.eye(2), (count, 1, 1, 1)),
        kind=np.zeros((count, 1), np.int32),
        landmark_index=np.full((count, 1), -1, np.int32),
        prior=LandmarkPrior(np.zeros((1, 2)), np.eye(2)[None]),  # of one that is never measured
    )
    tied = LoopClosures(*(ends[closures].T - 1), numbers[closures, :3], information[closures])
    with jax.enable_x64(True):
        found = smooth_log(
            problem, poses[1:], np.zeros((1, 2)), loop_closures=tied, robust_scale=np.inf
        )
    return np.concatenate([poses[:1], found.poses])


def read_g2o(path: Path) -> Numbers:
    """Figures of graph.g2o."""
    lines = [line.split() for line in path.read_text().splitlines()]
    edges = [line for line in lines if line[0] == "EDGE_SE2"]
    count, guess, theirs = optimum_of_gtsam(path)
    ours = own_optimum(edges, guess)
    difference = theirs - ours
    difference[:, 2] -= 2 * np.pi * np.round(difference[:, 2] / (2 * np.pi))
    return {
        "edges": len(edges),
        "edges_of_landmarks": sum(line[0] == "EDGE_SE2_XY" for line in lines),
        "factors_read": count,
        "moved_m": np.linalg.norm(theirs[:, :2] - guess[:, :2], axis=1).max(),
        "difference_m": np.linalg.norm(difference[:, :2], axis=1).max(),
        "difference_rad": np.abs(difference[:, 2]).max(),
        "optimum": theirs[:, :2],
        "own_optimum": ours[:, :2],
    }


def read_graphml(path: Path, features: list[Numbers]) -> Numbers:
    """How many nodes and arcs of map.graphml are as in map.geojson, open ends too."""
    import igraph

    graph = igraph.Graph.Read_GraphML(str(path))
    nodes, arcs = 0, 0
    for vertex in graph.vs:
        (point,) = [f for f in features if f["properties"]["id"] == int(vertex["name"])]
        nodes += point["geometry"]["coordinates"] == [vertex["x"], vertex["y"]]
    for edge in graph.es:
        its = [f["properties"] for f in features if "startid" in f["properties"]]
        its = [p for p in its if p["metadata"]["arc"] == int(edge["arc"])]
        names = {int(graph.vs[k]["name"]) for k in edge.tuple}
        ends = [{p["startid"], p["endid"]} == names for p in its]
        arcs += len(its) == 2 and all(ends) and its[0]["cost"] == edge["length"]
    count = {"nodes": graph.vcount(), "arcs": graph.ecount()}
    return count | {"right_nodes": nodes, "right_arcs": arcs}


def compute(folder: Path) -> Numbers:
    """All figures of a folder."""
    import yaml
    from vdma_lif.parser import LIFParser

    features = json.loads((folder / "map.geojson").read_text())["features"]
    (layout,) = LIFParser.from_file(str(folder / "map.lif.json")).layouts
    (level,) = yaml.safe_load((folder / "map.rmf.yaml").read_text())["levels"].values()
    return {
        "g2o": read_g2o(folder / "graph.g2o"),
        "graphml": read_graphml(folder / "map.graphml", features),
        "lif": {"nodes": len(layout.nodes), "edges": len(layout.edges)},
        "rmf": {"vertices": len(level["vertices"]), "lanes": len(level["lanes"])},
    }


def draw(numbers: Numbers, path: Path) -> None:
    """Draw both optima, one over the other."""
    figure, axes = common.canvas(6.0, 5.0, 1, 1)
    for key, colour, width, label in (
        ("own_optimum", common.SKY, 4.0, "optimum of jaxslam"),
        ("optimum", common.BLACK, 1.0, "optimum of GTSAM"),
    ):
        line = np.array(numbers["g2o"][key])
        axes[0, 0].plot(*line.T, color=colour, linewidth=width, label=label)
    axes[0, 0].set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes[0, 0].legend()
    figure.savefig(path)


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment from the command line."""
    given = common.parse(__doc__, argv, data=Path("out"))
    numbers = compute(given.data)
    g2o, graph = numbers["g2o"], numbers["graphml"]
    print(
        f"graph.g2o in GTSAM: {g2o['factors_read']} of {g2o['edges']} factors, and none of "
        f"{g2o['edges_of_landmarks']} of landmarks, by design; optimum {g2o['moved_m']:.3f} m from "
        f"the guess, {g2o['difference_m']:.5f} m and {g2o['difference_rad']:.6f} rad from ours\n"
        f"map.graphml in igraph: {graph['right_nodes']} of {graph['nodes']} nodes and "
        f"{graph['right_arcs']} of {graph['arcs']} arcs are right\n"
        f"map.lif.json in vdma-lif: {numbers['lif']}; map.rmf.yaml: {numbers['rmf']}"
    )
    common.save(given.out, NAME, numbers, draw)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
