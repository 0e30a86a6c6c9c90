import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from PIL import Image

from jaxslam.core.scan import Lidar, Scan
from jaxslam.frontend import lidar
from jaxslam.io import ros_map
from jaxslam.mapping import occupancy
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
    ends = np.asarray(jax.vmap(lidar.beam_ends, in_axes=(None, 0))(LIDAR, scans))
    ended, passed = [], []
    for pose, points, hit in zip(POSES, ends, np.asarray(scans.hit), strict=True):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        beams = points[hit] @ np.array([[c, s], [-s, c]])
        for fraction, cells in ((1.0, ended), (0.5, passed)):
            index = np.floor((pose[:2] + fraction * beams - found.origin[:2]) / 0.05).astype(int)
            cells.append((found.occupied[tuple(index.T)], found.free[tuple(index.T)]))
    # Where beams graze a wall, more pass a cell than end in it.
    assert np.concatenate([occupied for occupied, _ in ended]).mean() > 0.94
    assert np.concatenate([free for _, free in passed]).mean() > 0.99
    assert not (found.occupied & found.free).any()
    assert not (found.occupied | found.free)[[0, -1]].any()  # a margin of unknown cells


def test_a_map_too_large_gets_larger_cells(monkeypatch):
    monkeypatch.setattr(occupancy, "MAX_CELLS", 5000)
    coarse = occupancy.occupancy_map(LIDAR, POSES, scans_of(POSES), resolution=0.05)
    assert coarse.occupied.size <= 5000 and coarse.resolution == 0.1


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"resolution": 0.0}, "resolution is 0.0, not a positive number"),
        ({"poses": np.full((3, 3), np.nan)}, "poses: no pose is finite"),
        ({"poses": np.zeros((3, 2))}, r"poses is float64 \(3, 2\), not \(T, 3\)"),
        ({"poses": POSES[:2]}, r"scans.ranges is float64 \(3, 91\), not \(2, 91\)"),
        ({"poses": "here"}, "poses is .*, not numbers"),
        ({"lidar": Lidar(num_beams=90)}, r"scans.ranges is float64 \(3, 91\), not \(3, 90\)"),
        ({"lidar": 0.05}, "lidar is of type float, not Lidar"),
        ({"scans": POSES}, "scans is of type ndarray, not Scan"),
    ],
)
def test_occupancy_map_names_the_argument_that_does_not_fit(wrong, problem):
    given = {"lidar": LIDAR, "poses": POSES, "scans": scans_of(POSES), "resolution": 0.05}
    with pytest.raises(ValueError, match=problem):
        occupancy.occupancy_map(**{**given, **wrong})


def test_hits_that_are_not_booleans_are_refused():
    scans = scans_of(POSES)
    scans = scans._replace(hit=np.asarray(scans.hit, int))
    with pytest.raises(ValueError, match=r"scans.hit is int64 \(3, 91\), not bool"):
        occupancy.occupancy_map(LIDAR, POSES, scans, resolution=0.05)


def test_lists_numpy_and_jax_arrays_give_the_same_occupancy_map():
    scans, poses = scans_of(POSES), np.float32(POSES)
    want = occupancy.occupancy_map(LIDAR, np.float64(poses), scans, resolution=0.05)
    for convert in (np.asarray, lambda x: np.asarray(x).tolist(), jnp.asarray):
        given = convert(poses), type(scans)(*map(convert, scans))
        again = occupancy.occupancy_map(LIDAR, *given, resolution=0.05)
        jax.tree.map(np.testing.assert_array_equal, again, want)


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


def test_space_between_beams_is_free_where_they_are_near_each_other():
    """A wall at 8 m, by beams 4 degrees apart: their gap is a cell at 0.7 m, `MAX_GAP` at 2.9 m."""
    sparse = Lidar(num_beams=21, angle_min=-np.pi / 9, angle_increment=np.pi / 45, range_max=20.0)
    angle = sparse.angle_min + sparse.angle_increment * np.arange(21)
    scan = Scan(8.0 / np.cos(angle)[None], np.ones((1, 21), bool))
    grid = occupancy.occupancy_map(sparse, np.zeros((1, 3)), scan, resolution=0.05)
    centre = (np.argwhere(grid.free) + 0.5) * 0.05 + grid.origin[:2]
    bearing = np.arctan2(*centre.T[::-1])
    from_beam = np.abs(bearing[:, None] - angle).min(axis=1) * np.hypot(*centre.T)
    between = from_beam > 0.06
    reach = occupancy.MAX_GAP / sparse.angle_increment
    assert np.hypot(*centre[between].T).max() < reach + 0.1
    x, y = np.meshgrid(np.arange(0.8, 2.7, 0.05), np.arange(-0.2, 0.2, 0.05))
    index = np.floor((np.stack([x, y], -1).reshape(-1, 2) - grid.origin[:2]) / 0.05).astype(int)
    assert grid.free[tuple(index.T)].mean() > 0.97
