import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.optimize import least_squares

from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import relative
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import lidar
from jaxslam.io import g2o_writer, ros_map
from jaxslam.io.errors import InputError
from jaxslam.mapping import occupancy, pose_graph
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.pipeline import offline
from jaxslam.pipeline.config import Config
from jaxslam.simulation import ray_casting, worlds

LIDAR = Lidar(num_beams=91, angle_increment=np.pi / 90, range_max=8.0)
ROOM = worlds.named("fig07")
POSES = np.array([[1.0, 1.0, 0.3], [2.0, 1.5, 1.0], [3.0, 2.0, -0.5]])


@jax.jit
@jax.vmap
def scans_of(pose):
    return ray_casting.cast(LIDAR, ROOM, pose)


@pytest.fixture(scope="module")
def found():
    return occupancy.occupancy_map(LIDAR, POSES, scans_of(POSES), resolution=0.05)


def test_beams_end_in_occupied_cells_and_pass_free_ones(found):
    scans = scans_of(POSES)
    ends = np.asarray(jax.vmap(lidar.beam_ends, in_axes=(0, None))(scans, LIDAR))
    ended, passed = [], []
    for pose, points, hit in zip(POSES, ends, np.asarray(scans.hit), strict=True):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        way = points[hit] @ np.array([[c, s], [-s, c]])
        for part, cells in ((1.0, ended), (0.5, passed)):
            at = np.floor((pose[:2] + part * way - found.origin[:2]) / 0.05).astype(int)
            cells.append((found.occupied[tuple(at.T)], found.free[tuple(at.T)]))
    # Where beams graze a wall, more pass a cell than end in it.
    assert np.concatenate([one[0] for one in ended]).mean() > 0.94
    assert np.concatenate([one[1] for one in passed]).mean() > 0.99
    assert not (found.occupied & found.free).any()
    assert not (found.occupied | found.free)[[0, -1]].any()  # a margin of unknown cells


def test_a_map_too_large_gets_larger_cells(monkeypatch):
    monkeypatch.setattr(occupancy, "CELLS", 5000)
    coarse = occupancy.occupancy_map(LIDAR, POSES, scans_of(POSES), resolution=0.05)
    assert coarse.occupied.size <= 5000 and coarse.resolution == 0.1


@pytest.mark.parametrize(
    "poses, resolution, problem",
    [(POSES, 0.0, "resolution of 0.0 m"), (np.full((3, 3), np.nan), 0.05, "no pose is finite")],
)
def test_what_cannot_be_mapped(poses, resolution, problem):
    with pytest.raises(ValueError, match=problem):
        occupancy.occupancy_map(LIDAR, poses, scans_of(POSES), resolution=resolution)


def test_a_map_is_read_back_by_its_reader_and_by_others(found, tmp_path):
    ros_map.write(tmp_path / "map.yaml", found)
    again = ros_map.read(tmp_path / "map.yaml")
    np.testing.assert_array_equal(again.occupied, found.occupied)
    np.testing.assert_array_equal(again.free, found.free)
    np.testing.assert_array_equal(again.origin, found.origin)
    fields = yaml.safe_load((tmp_path / "map.yaml").read_text())
    assert fields["resolution"] == 0.05 and fields["image"] == "map.pgm"
    shade = np.asarray(Image.open(tmp_path / "map.pgm"))
    assert shade.shape == found.free.shape[::-1]
    i, j = np.argwhere(found.occupied)[0]
    assert shade[shade.shape[0] - 1 - j, i] == 0


@pytest.fixture(scope="module")
def drive():
    """A filtered drive around the room: survey, noise, inputs, config, true poses."""
    config = Config.for_lidar(
        LIDAR,
        filter=FilterConfig(
            max_landmarks=24,
        ),
    )
    turn = np.linspace(0.0, 2.0, 12)
    true = np.stack([2.5 + np.cos(turn), 2.0 + np.sin(turn), turn + np.pi / 2], axis=1)
    rng = np.random.default_rng(0)
    noise = NoiseParams.for_simulated_robot()
    step = np.hypot(*(true[1] - true[0])[:2])
    moves = np.array([[step * np.cos(0.09), step * np.sin(0.09), turn[1]]] * 11)
    moves += rng.normal(0, [0.002, 0.001, 0.004], moves.shape)
    moves = jnp.concatenate([jnp.zeros((1, 3)), jnp.asarray(moves)])
    scans = jax.vmap(ray_casting.add_range_noise, in_axes=(0, 0, None))(
        jax.random.split(jax.random.key(0), 12), scans_of(true), LIDAR
    )
    survey = offline.run_slam(config, noise, jnp.asarray(true[0]), moves, scans)
    return survey, noise, Measurement(moves, survey.features), config, true


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


def test_an_optimiser_finds_the_drive_in_its_graph(drive, tmp_path):
    survey, noise, inputs, config, true = drive
    tie = relative(true[2], true[9])[None], 1e4 * np.eye(3)[None]
    survey = survey._replace(loop_closures=LoopClosures(np.array([2]), np.array([9]), *tie))
    g2o_writer.write(
        tmp_path / "graph.g2o", pose_graph.build_pose_graph(config, noise, survey, inputs)
    )
    graph = parsed(tmp_path / "graph.g2o")
    poses = {names[0]: np.array(x) for names, x in graph["VERTEX_SE2"]}
    marks = {names[0]: np.array(x) for names, x in graph["VERTEX_XY"]}
    assert list(poses) == list(range(12)) and len(marks) > 4 and len(graph["EDGE_SE2"]) == 12
    assert graph["EDGE_SE2"][-1][0] == [2, 9]
    assert len(graph["EDGE_SE2_XY"]) > 30 and graph["FIX"] == [([0], [])]
    order = {name: 3 * 11 + 2 * k for k, name in enumerate(marks)}

    def turned(angle, v):
        c, s = np.cos(angle), np.sin(angle)
        return np.array([c * v[0] + s * v[1], c * v[1] - s * v[0]])

    def residuals(x):
        pose = lambda k: poses[0] if k == 0 else x[3 * k - 3 : 3 * k]
        all = []
        for (a, b), (*move, i, j, k, l, m, n) in graph["EDGE_SE2"]:
            off = np.append(turned(pose(a)[2], pose(b)[:2] - pose(a)[:2]), pose(b)[2] - pose(a)[2])
            error = off - move
            error[2] = (error[2] + np.pi) % (2 * np.pi) - np.pi
            all.append(root_of([i, j, k, l, m, n], 3) @ error)
        for (a, b), (u, v, i, j, k) in graph["EDGE_SE2_XY"]:
            place = x[order[b] : order[b] + 2]
            error = turned(pose(a)[2], place - pose(a)[:2]) - [u, v]
            all.append(root_of([i, j, k], 2) @ error)
        return np.concatenate(all)

    guess = np.concatenate([*list(poses.values())[1:], *marks.values()])
    best = least_squares(residuals, guess)
    error = best.x[:33].reshape(11, 3) - true[1:]
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.hypot(*error[:, :2].T).max() < 0.02 and np.abs(error[:, 2]).max() < 0.01
    count = len(best.fun) - len(guess)
    assert 0.2 * count < 2 * best.cost < 2.0 * count  # chi-square: as large as it should be


def test_numbers_that_are_not_finite_are_not_written(drive, tmp_path):
    survey, noise, inputs, config, _ = drive
    graph = pose_graph.build_pose_graph(config, noise, survey, inputs)
    bad = graph._replace(landmark_positions=np.full_like(graph.landmark_positions, np.nan))
    with pytest.raises(InputError, match="places holds numbers that are not finite"):
        g2o_writer.write(tmp_path / "graph.g2o", bad)
    assert not any(tmp_path.iterdir())
