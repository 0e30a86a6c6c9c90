import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from small import CONFIG, LIDAR

from jaxslam.core.measurement import Measurement
from jaxslam.core.se2_np import relative
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import g2o_writer
from jaxslam.io.errors import InputError
from jaxslam.mapping import pose_graph
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.pipeline import offline
from jaxslam.pipeline.config import Config
from jaxslam.simulation import ray_casting, worlds

ROOM = worlds.named("fig07")


@jax.jit
@jax.vmap
def scans_of(pose):
    return ray_casting.cast(LIDAR, ROOM, pose)


@pytest.fixture(scope="module")
def drive():
    """A filtered drive around the room: result, arguments of `build_pose_graph`, true poses."""
    turn = np.linspace(0.0, 2.0, 12)
    true = np.stack([2.5 + np.cos(turn), 2.0 + np.sin(turn), turn + np.pi / 2], axis=1)
    rng = np.random.default_rng(0)
    params = NoiseParams.for_simulated_robot()
    step = np.hypot(*(true[1] - true[0])[:2])
    odometry = np.array([[step * np.cos(0.09), step * np.sin(0.09), turn[1]]] * 11)
    odometry += rng.normal(0, [0.002, 0.001, 0.004], odometry.shape)
    odometry = jnp.concatenate([jnp.zeros((1, 3)), jnp.asarray(odometry)])
    scans = jax.vmap(ray_casting.add_range_noise, in_axes=(0, None, 0))(
        jax.random.split(jax.random.key(0), 12), LIDAR, scans_of(true)
    )
    plain = {"match_scans": False, "smooth": False}
    result = offline.run_slam(CONFIG, params, odometry, scans, start=true[0], **plain)
    given = {
        "config": CONFIG.filter,
        "params": params,
        "poses": result.poses,
        "belief": result.belief,
        "info": result.info,
        "measurements": Measurement(odometry, result.features),
    }
    return given, true


def parsed(path):
    """Lines of a g2o file by kind: names and numbers."""
    known = {"VERTEX_SE2": 1, "VERTEX_XY": 1, "EDGE_SE2": 2, "EDGE_SE2_XY": 2, "FIX": 1}
    found = {kind: [] for kind in known}
    for line in path.read_text().splitlines():
        kind, *rest = line.split()
        names = [int(x) for x in rest[: known[kind]]]
        found[kind].append((names, [float(x) for x in rest[known[kind] :]]))
    return found


def root_of(upper, size):
    """Square root of the information whose upper triangle is given."""
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = upper
    return np.linalg.cholesky(matrix + np.triu(matrix, 1).T).T


@pytest.mark.slow
def test_an_optimiser_finds_the_true_trajectory_in_the_pose_graph(drive, tmp_path):
    given, true = drive
    measured = relative(true[2], true[9])[None], 1e4 * np.eye(3)[None]
    loop_closures = LoopClosures(np.array([2]), np.array([9]), *measured)
    built = pose_graph.build_pose_graph(**given, loop_closures=loop_closures)
    g2o_writer.write(tmp_path / "graph.g2o", built)
    graph = parsed(tmp_path / "graph.g2o")
    poses = {names[0]: np.array(x) for names, x in graph["VERTEX_SE2"]}
    landmarks = {names[0]: np.array(x) for names, x in graph["VERTEX_XY"]}
    assert list(poses) == list(range(12)) and len(landmarks) > 4 and len(graph["EDGE_SE2"]) == 12
    assert graph["EDGE_SE2"][-1][0] == [2, 9]
    assert len(graph["EDGE_SE2_XY"]) > 30 and graph["FIX"] == [([0], [])]
    order = {name: 3 * 11 + 2 * k for k, name in enumerate(landmarks)}

    def rotated(angle, v):
        c, s = np.cos(angle), np.sin(angle)
        return np.array([c * v[0] + s * v[1], c * v[1] - s * v[0]])

    def residuals(x):
        pose = [poses[0], *x[:33].reshape(11, 3)]
        whitened = []
        for (a, b), (*measured, i, j, k, u, v, w) in graph["EDGE_SE2"]:
            motion = rotated(pose[a][2], pose[b][:2] - pose[a][:2])
            moved = rotated(measured[2], motion - measured[:2])  # in the measured second frame
            error = np.append(moved, pose[b][2] - pose[a][2] - measured[2])
            error[2] = (error[2] + np.pi) % (2 * np.pi) - np.pi
            whitened.append(root_of([i, j, k, u, v, w], 3) @ error)
        for (a, b), (u, v, i, j, k) in graph["EDGE_SE2_XY"]:
            landmark = x[order[b] : order[b] + 2]
            error = rotated(pose[a][2], landmark - pose[a][:2]) - [u, v]
            whitened.append(root_of([i, j, k], 2) @ error)
        return np.concatenate(whitened)

    guess = np.concatenate([*list(poses.values())[1:], *landmarks.values()])
    best = least_squares(residuals, guess)
    error = best.x[:33].reshape(11, 3) - true[1:]
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.hypot(*error[:, :2].T).max() < 0.02 and np.abs(error[:, 2]).max() < 0.01
    count = len(best.fun) - len(guess)
    assert 0.2 * count < 2 * best.cost < 2.0 * count  # chi-square: as large as it should be


@pytest.mark.slow
def test_numbers_that_are_not_finite_are_not_written(drive, tmp_path):
    graph = pose_graph.build_pose_graph(**drive[0])
    bad = graph._replace(landmark_positions=np.full_like(graph.landmark_positions, np.nan))
    with pytest.raises(InputError, match="holds numbers that are not finite"):
        g2o_writer.write(tmp_path / "graph.g2o", bad)
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_lists_numpy_and_jax_arrays_give_the_same_pose_graph(drive):
    given = {**drive[0], "poses": np.float32(drive[0]["poses"])}
    want = pose_graph.build_pose_graph(**given)
    for convert in (np.asarray, jnp.asarray):
        leaves = {name: jax.tree.map(convert, given[name]) for name in ("belief", "info")}
        measurements = jax.tree.map(convert, given["measurements"])
        converted = {**given, **leaves, "measurements": measurements}
        converted["poses"] = given["poses"].tolist() if convert is np.asarray else given["poses"]
        graph = pose_graph.build_pose_graph(**converted)
        jax.tree.map(np.testing.assert_array_equal, graph, want)


@pytest.mark.slow
def test_build_pose_graph_names_the_argument_that_does_not_fit(drive):
    measurements, info = drive[0]["measurements"], drive[0]["info"]
    for wrong, problem in (
        ({"config": Config()}, "config is of type Config, not FilterConfig"),
        ({"belief": info}, "belief is of type StepInfo, not Belief"),
        ({"poses": np.zeros((12, 2))}, r"poses is float64 \(12, 2\), not \(T, 3\)"),
        ({"poses": np.zeros((11, 3))}, r"measurements.odometry is float64 \(12, 3\), not .*11, 3"),
        ({"info": info._replace(id=info.id[:11])}, r"info.id is int32 \(11, \d+\), not integer"),
        ({"info": info._replace(id=info.pose)}, r"info.id is float64 \(12, 3\), not integer"),
        ({"measurements": measurements.features}, "measurements is of type Features"),
    ):
        with pytest.raises(ValueError, match=problem):
            pose_graph.build_pose_graph(**{**drive[0], **wrong})
