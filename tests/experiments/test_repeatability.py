import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import ground_truth, repeatability, thinning, viewpoints
from experiments.viewpoints import CellWorld, Viewpoints, WallWorld
from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar
from jaxslam.core.types import CORNER, JUNCTION
from jaxslam.frontend.grid import GridSpec
from jaxslam.simulation import ray_casting
from jaxslam.simulation.worlds import World, outline

CASE = repeatability.DEFAULT
ROOM = WallWorld(outline([(0.0, 0.0, 6.0, 4.0)]))  # its junctions are (2, 2) and (4, 2)
POSES = np.array([[1.0, 2.0, 0.0], [1.5, 1.5, 0.1]])  # both see the circle about (4, 2)
LANDMARKS = [[4.0, 2.0], [6.0, 0.0], [6.0, 4.0]]


def seen(poses, positions):
    """Landmarks at positions (N, 3, 2) of the world: a junction and two corners from each pose."""
    away = np.asarray(positions, float) - poses[:, None, :2]
    away = (away[..., 0] + 1j * away[..., 1]) * np.exp(-1j * poses[:, 2:])
    n, m = away.shape
    yes, zero = np.ones((n, m), bool), np.zeros((n, m))
    return Features(
        kind=np.tile([JUNCTION, CORNER, CORNER], (n, 1)),
        xy=np.stack([away.real, away.imag], axis=-1),
        cov=np.tile(1e-4 * np.eye(2), (n, m, 1, 1)),
        direction=zero,
        direction_variance=zero,
        descriptor=np.tile([2.0, np.pi / 2, np.pi / 2], (n, 1)),
        degree=np.tile([3, 2, 2], (n, 1)),
        certified=yes,
        trusted=yes.copy(),
        valid=yes.copy(),
    )


def checked(poses, found):
    """The row of either kind."""
    corners = viewpoints.visible_corners(CASE.config, ROOM, poses)
    views = Viewpoints(ROOM, poses, np.zeros((len(poses), 0)), corners)
    part = repeatability.check(CASE.config, views, found, ROOM.kinds)
    return {kind: repeatability.row([own]) for kind, own in part.items()}


def test_perfect_landmarks_repeat_and_none_is_spurious():
    for kind, count in (("node", 1), ("corner", 2)):
        row = checked(POSES, seen(POSES, [LANDMARKS] * 2))[kind]
        assert row["checks"] == 2 * count and row["per_scan"] == count
        assert row["repeatability"] == 1.0 and row["spurious"] == 0.0
        np.testing.assert_allclose([row["spread_m"], row["nees"], row["error_m"]], 0.0, atol=1e-12)


def test_a_small_error_counts_in_spread_and_nees():
    off = np.add(LANDMARKS, [[0.02, 0.0], [0.0, 0.0], [0.0, 0.0]])
    row = checked(POSES, seen(POSES, [LANDMARKS, off]))["node"]
    assert row["repeatability"] == 1.0 and row["spurious"] == 0.0
    np.testing.assert_allclose(row["spread_m"], 0.02)
    np.testing.assert_allclose(row["nees"], (0.02**2 / 1e-4 / 2) / 2)  # the mean of two


@pytest.mark.parametrize("which, kind", [(0, "node"), (1, "corner")])
def test_a_landmark_30_cm_off_does_not_repeat_and_is_spurious(which, kind):
    off = np.array(LANDMARKS)
    off[which, 0] -= 0.3
    found = seen(POSES, [LANDMARKS, off])
    found.descriptor[1, 0] = 1.7  # its circle stays in the room
    row = checked(POSES, found)[kind]
    if kind == "node":
        assert row["checks"] == 2 and row["repeatability"] == 0.0 and row["spurious"] == 0.5
    else:  # a false corner need not repeat; the other one does
        assert row["checks"] == 3 and row["repeatability"] == 2 / 3 and row["spurious"] == 0.25


@pytest.mark.parametrize("other, corners", [([1.5, 1.5, np.pi], 0), ([4.0, 3.0, -np.pi / 2], 1)])
def test_a_landmark_that_one_side_alone_sees_is_no_check(other, corners):
    poses = np.array([POSES[0], other])
    rows = checked(poses, seen(poses, [LANDMARKS] * 2))
    row = rows["node"]
    assert row["checks"] == 0 and np.isnan(row["repeatability"]) and row["spurious"] == 0.0
    assert rows["corner"]["checks"] == 2 * corners


def test_all_label_modes_look_at_the_same_noisy_scans(monkeypatch):
    def ranges_as_features(config, scans):
        return Features(*[scans.ranges] * len(Features._fields))

    monkeypatch.setattr(repeatability, "_features", ranges_as_features)
    monkeypatch.setattr(thinning, "landmarks", ranges_as_features)
    ranges = ROOM.ranges(POSES, CASE.config.lidar)
    views = Viewpoints(ROOM, POSES, ranges, np.zeros((2, 0), bool))
    worlds = {"one": [views, views], "two": [views]}
    for skip in (1, 2):
        got = [
            repeatability.find_landmarks(
                jax.random.key(0), worlds, repeatability.Case(labels, 0.01, skip)
            )
            for labels in ("segments", "codes", "thinning")
        ]
        for case in got:
            assert [len(case[name]) for name in worlds] == [2, 1]
            np.testing.assert_array_equal(case["two"][0][1].xy, got[0]["two"][0][1].xy)
        noise = got[0]["one"][1][1].xy - ranges[:, ::skip]
        np.testing.assert_allclose(noise.std(), 0.01, rtol=0.2)
    assert CASE.config.lidar == Lidar()
    assert repeatability.COARSE.config.lidar.num_beams == ranges[:, ::2].shape[1]


def test_a_wall_between_hides_a_circle():
    wall = np.array([[2.5, 1.0, 2.5, 1.4]])
    split = WallWorld(np.vstack([ROOM.walls, wall]))
    circle = np.array([[4.0, 2.0]] * 2), np.full(2, 1.0)
    got = [viewpoints.visible_circles(CASE.config, p, POSES, *circle) for p in (ROOM, split)]
    np.testing.assert_array_equal(got, [[True, True], [True, False]])


def test_a_landmark_that_is_not_trusted_may_be_matched_but_is_not_checked():
    found = seen(POSES, [LANDMARKS] * 2)
    found.trusted[1] = False
    row = checked(POSES, found)["node"]
    assert row["checks"] == 1 and row["repeatability"] == 1.0 and row["per_scan"] == 0.5
    found.valid[1] = False
    assert checked(POSES, found)["node"]["repeatability"] == 0.0


def test_the_view_is_180_degrees_ahead_and_ends_with_the_grid():
    pose = np.array([[1.0, 2.0, np.pi / 2]])  # it looks along y
    points = [[1.0, 5.0], [4.0, 2.01], [4.0, 1.99], [-2.0, 2.01], [1.0, 1.0], [1.0, 9.9], [1.0, 11]]
    got = viewpoints.in_view(CASE.config, pose, np.array([points], float))
    np.testing.assert_array_equal(got, [[True, True, False, True, False, True, False]])


def test_corners_are_seen_by_five_beams_on_either_wall():
    poses = np.array([[1.0, 2.0, 0.0], [1.0, 2.0, np.pi], [5.999, 2.0, 0.0]])
    order = np.argsort(ROOM.corners.xy @ [1.0, 0.1])  # (0, 0), (0, 4), (6, 0), (6, 4)
    got = viewpoints.visible_corners(CASE.config, ROOM, poses)[:, order]
    # The last stands so near the wall that it sees no more than the end of the others.
    np.testing.assert_array_equal(got, [[0, 0, 1, 1], [1, 1, 0, 0], [0, 0, 0, 0]])


def scattered():
    """Cells, a third of them solid, the walls between, and points in free cells."""
    rng = np.random.default_rng(0)
    free = np.pad(rng.random((14, 11)) > 0.3, 1)
    walls = []
    for axis in (0, 1):
        start = np.argwhere(np.diff(free, axis=axis)) + np.eye(2, dtype=int)[axis]
        walls.append(np.hstack([start, start + np.eye(2, dtype=int)[1 - axis]]))
    cells = np.argwhere(free)
    points = (cells[rng.integers(len(cells), size=40)] + rng.uniform(0, 1, (40, 2))) / 2
    return CellWorld(~free, free, 0.5), np.concatenate(walls) / 2, points


def test_rays_through_cells_end_where_walls_on_their_borders_are():
    world, walls, eyes = scattered()
    poses = np.column_stack([eyes, np.linspace(-np.pi, np.pi, len(eyes))])
    lidar = Lidar(num_beams=90, angle_increment=0.07)
    cast = partial(ray_casting.cast, lidar, World(jnp.asarray(walls)))
    wanted = jax.jit(jax.vmap(cast))(jnp.asarray(poses))
    got = world.ranges(poses, lidar)
    assert np.asarray(wanted.hit).all()
    np.testing.assert_allclose(got, wanted.ranges, atol=1e-9)


def test_sight_through_cells_is_that_past_walls_on_their_borders():
    world, walls, eyes = scattered()
    points = np.tile(eyes[::-1], (len(eyes), 1, 1))
    got, wanted = world.in_sight(eyes, points), ground_truth.in_sight(eyes, points, walls)
    np.testing.assert_array_equal(got, wanted)
    assert 0.02 < got.mean() < 0.9


def test_a_ray_that_leaves_the_map_has_no_end():
    world = CellWorld(np.zeros((4, 4), bool), np.ones((4, 4), bool), 1.0)
    got = world.distance_along(np.array([[1.5, 1.5]] * 2), np.array([[1.0, 0.0], [0.0, -1.0]]))
    np.testing.assert_array_equal(got, np.inf)


def test_junctions_of_a_room_of_cells_are_those_of_its_walls():
    free = np.pad(np.ones((60, 40), bool), 1)
    world = CellWorld(~free, free, 0.1)
    inner = world.junctions[world.contains(world.junctions)] - 0.1
    for wanted in ROOM.junctions:
        assert np.hypot(*(inner - wanted).T).min() < 0.02
    gap = np.hypot(*np.moveaxis(inner[:, None] - ROOM.junctions, -1, 0)).min(axis=1)
    assert gap.max() < 0.05


def test_neighbouring_hits_are_one_wall_unless_far_apart():
    spec = GridSpec(x_max=1.0, x_min=0.0, y_half=0.5)
    ends = np.array([[0.55, -0.25], [0.55, -0.05], [0.55, 0.45], [9.0, 9.0]])
    cells = thinning.wall_cells(spec, ends, np.array([True, True, True, False]))
    assert set(map(tuple, np.argwhere(cells))) == {(5, 2), (5, 3), (5, 4), (5, 9)}


def test_thinning_finds_the_crossing_of_two_corridors_and_no_spur():
    if thinning.missing():
        pytest.skip("scikit-image or sknw is not installed")
    free = np.zeros((41, 41), bool)
    free[17:24, 2:39] = free[2:39, 17:24] = True
    free[24:26, 8] = True  # a niche
    xy, clearance = thinning.junctions(free)
    np.testing.assert_allclose(xy, [[20.0, 20.0]], atol=1.0)
    np.testing.assert_allclose(clearance, np.hypot(4, 4) - 0.5)


def test_few_pairs_without_map_and_peer_give_null(tmp_path, monkeypatch, capsys):
    def find_nothing(key, worlds, case):
        return {name: [(view, nothing(view)) for view in views] for name, views in worlds.items()}

    def nothing(view):
        shape = len(view.poses), 3
        found = seen(view.poses, np.zeros((*shape, 2)))
        return found._replace(valid=np.zeros(shape, bool), trusted=np.zeros(shape, bool))

    monkeypatch.setattr(repeatability, "find_landmarks", find_nothing)
    monkeypatch.setattr(repeatability, "WallWorld", lambda walls: ROOM)  # faster
    monkeypatch.setattr(repeatability, "WILLOW", tmp_path / "none.yaml")
    monkeypatch.setattr(thinning, "NEEDS", ("math", "no.such.module"))
    repeatability.main(["--out", str(tmp_path), "--pairs", "1", "--plans", "1"])
    numbers = json.loads((tmp_path / "repeatability.json").read_text())
    assert numbers["not_installed"] == ["no.such.module"]
    assert "none.yaml" in str(numbers["left_out"])
    assert len(numbers["rows"]) == 2 * 3 * 2 * 2  # labels, noises, worlds, kinds
    assert {row["labels"] for row in numbers["rows"]} == {"runs", "codes"}
    keys = "world labels kind noise_m repeatability spurious spread_m nees per_scan checks".split()
    for row in numbers["rows"]:
        assert set(keys) <= set(row)
        assert row["checks"] == 0 and row["repeatability"] is None and row["per_scan"] == 0
    for name, bins in (("by_distance", 3), ("by_heading", 3), ("by_step", 2)):
        assert len(numbers[name]) == bins * 2 * 2
    assert (tmp_path / "repeatability.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert "without thinning" in printed and "without willow" in printed
    assert "segments" in printed and "runs" not in printed
