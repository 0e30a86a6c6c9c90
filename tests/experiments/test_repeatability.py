import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import repeatability, thinning, truth, viewpoints
from experiments.viewpoints import Cells, Drawn, Scene
from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar
from jaxslam.core.types import CORNER, JUNCTION
from jaxslam.frontend.grid import GridSpec
from jaxslam.simulation import ray_casting
from jaxslam.simulation.worlds import World, outline

CASE = repeatability.USUAL
ROOM = Drawn(outline([(0.0, 0.0, 6.0, 4.0)]))  # its junctions are (2, 2) and (4, 2)
POSES = np.array([[1.0, 2.0, 0.0], [1.5, 1.5, 0.1]])  # both see the circle about (4, 2)
PLACES = [[4.0, 2.0], [6.0, 0.0], [6.0, 4.0]]


def seen(poses, places):
    """Landmarks at places (N, 3, 2) of the world: a junction and two corners from each pose."""
    away = np.asarray(places, float) - poses[:, None, :2]
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


def judged(poses, found):
    """The row of either kind."""
    corners = viewpoints.visible_corners(ROOM, poses, CASE.config)
    at = Scene(ROOM, poses, np.zeros((len(poses), 0)), corners)
    part = repeatability.judge(CASE.config, at, found, ROOM.filter.landmark_kinds)
    return {kind: repeatability.row([own]) for kind, own in part.items()}


def test_perfect_landmarks_repeat_and_none_is_spurious():
    for kind, count in (("node", 1), ("corner", 2)):
        row = judged(POSES, seen(POSES, [PLACES] * 2))[kind]
        assert row["checks"] == 2 * count and row["per_scan"] == count
        assert row["repeatability"] == 1.0 and row["spurious"] == 0.0
        np.testing.assert_allclose([row["spread_m"], row["nees"], row["error_m"]], 0.0, atol=1e-12)


def test_a_small_error_counts_in_spread_and_nees():
    off = np.add(PLACES, [[0.02, 0.0], [0.0, 0.0], [0.0, 0.0]])
    row = judged(POSES, seen(POSES, [PLACES, off]))["node"]
    assert row["repeatability"] == 1.0 and row["spurious"] == 0.0
    np.testing.assert_allclose(row["spread_m"], 0.02)
    np.testing.assert_allclose(row["nees"], (0.02**2 / 1e-4 / 2) / 2)  # the mean of two


@pytest.mark.parametrize("which, kind", [(0, "node"), (1, "corner")])
def test_a_landmark_30_cm_off_does_not_repeat_and_is_spurious(which, kind):
    off = np.array(PLACES)
    off[which, 0] -= 0.3
    found = seen(POSES, [PLACES, off])
    found.descriptor[1, 0] = 1.7  # its circle stays in the room
    row = judged(POSES, found)[kind]
    if kind == "node":
        assert row["checks"] == 2 and row["repeatability"] == 0.0 and row["spurious"] == 0.5
    else:  # a false corner need not repeat; the other one does
        assert row["checks"] == 3 and row["repeatability"] == 2 / 3 and row["spurious"] == 0.25


@pytest.mark.parametrize("other, corners", [([1.5, 1.5, np.pi], 0), ([4.0, 3.0, -np.pi / 2], 1)])
def test_what_one_side_alone_sees_is_no_check(other, corners):
    poses = np.array([POSES[0], other])
    rows = judged(poses, seen(poses, [PLACES] * 2))
    row = rows["node"]
    assert row["checks"] == 0 and np.isnan(row["repeatability"]) and row["spurious"] == 0.0
    assert rows["corner"]["checks"] == 2 * corners


def test_all_label_modes_look_at_the_same_noisy_scans(monkeypatch):
    told = lambda config, scans: Features(*[scans.ranges] * len(Features._fields))
    monkeypatch.setattr(repeatability, "_features", told)
    monkeypatch.setattr(thinning, "landmarks", told)
    ranges = ROOM.ranges(POSES, CASE.config.frontend.lidar)
    at = Scene(ROOM, POSES, ranges, np.zeros((2, 0), bool))
    worlds = {"one": [at, at], "two": [at]}
    for skip in (1, 2):
        got = [
            repeatability.look(jax.random.key(0), worlds, repeatability.Case(labels, 0.01, skip))
            for labels in ("runs", "codes", "thinning")
        ]
        for case in got:
            assert [len(case[name]) for name in worlds] == [2, 1]
            np.testing.assert_array_equal(case["two"][0][1].xy, got[0]["two"][0][1].xy)
        noise = got[0]["one"][1][1].xy - ranges[:, ::skip]
        np.testing.assert_allclose(noise.std(), 0.01, rtol=0.2)
    assert CASE.config.frontend.lidar == Lidar()
    assert repeatability.COARSE.config.frontend.lidar.num_beams == ranges[:, ::2].shape[1]


def test_a_wall_between_hides_a_circle():
    wall = np.array([[2.5, 1.0, 2.5, 1.4]])
    split = Drawn(np.vstack([ROOM.max_walls, wall]))
    circle = np.array([[4.0, 2.0]] * 2), np.full(2, 1.0)
    got = [viewpoints.visible_circles(p, POSES, *circle, CASE.config) for p in (ROOM, split)]
    np.testing.assert_array_equal(got, [[True, True], [True, False]])


def test_what_is_not_trusted_may_be_met_but_is_not_checked():
    found = seen(POSES, [PLACES] * 2)
    found.trusted[1] = False
    row = judged(POSES, found)["node"]
    assert row["checks"] == 1 and row["repeatability"] == 1.0 and row["per_scan"] == 0.5
    found.valid[1] = False
    assert judged(POSES, found)["node"]["repeatability"] == 0.0


def test_the_view_is_180_degrees_ahead_and_ends_with_the_grid():
    pose = np.array([[1.0, 2.0, np.pi / 2]])  # it looks along y
    places = [[1.0, 5.0], [4.0, 2.01], [4.0, 1.99], [-2.0, 2.01], [1.0, 1.0], [1.0, 9.9], [1.0, 11]]
    got = viewpoints.in_view(pose, np.array([places], float), CASE.config)
    np.testing.assert_array_equal(got, [[True, True, False, True, False, True, False]])


def test_corners_are_seen_by_five_beams_on_either_wall():
    poses = np.array([[1.0, 2.0, 0.0], [1.0, 2.0, np.pi], [5.999, 2.0, 0.0]])
    order = np.argsort(ROOM.max_corners.xy @ [1.0, 0.1])  # (0, 0), (0, 4), (6, 0), (6, 4)
    got = viewpoints.visible_corners(ROOM, poses, CASE.config)[:, order]
    # The last stands so near the wall that it sees no more than the end of the others.
    np.testing.assert_array_equal(got, [[0, 0, 1, 1], [1, 1, 0, 0], [0, 0, 0, 0]])


def scattered():
    """Cells, a third of them solid, the walls between, and places in free cells."""
    rng = np.random.default_rng(0)
    free = np.pad(rng.random((14, 11)) > 0.3, 1)
    walls = []
    for axis in (0, 1):
        start = np.argwhere(np.diff(free, axis=axis)) + np.eye(2, dtype=int)[axis]
        walls.append(np.hstack([start, start + np.eye(2, dtype=int)[1 - axis]]))
    cells = np.argwhere(free)
    places = (cells[rng.integers(len(cells), size=40)] + rng.uniform(0, 1, (40, 2))) / 2
    return Cells(~free, free, 0.5), np.concatenate(walls) / 2, places


def test_rays_through_cells_end_where_walls_on_their_borders_are():
    place, walls, eyes = scattered()
    poses = np.column_stack([eyes, np.linspace(-np.pi, np.pi, len(eyes))])
    scanner = Lidar(num_beams=90, angle_increment=0.07)
    one = lambda pose: ray_casting.cast(scanner, World(jnp.asarray(walls)), pose)
    wanted = jax.jit(jax.vmap(one))(jnp.asarray(poses))
    got = place.ranges(poses, scanner)
    assert np.asarray(wanted.hit).all()
    np.testing.assert_allclose(got, wanted.ranges, atol=1e-9)


def test_sight_through_cells_is_that_past_walls_on_their_borders():
    place, walls, eyes = scattered()
    places = np.tile(eyes[::-1], (len(eyes), 1, 1))
    got, wanted = place.in_sight(eyes, places), truth.in_sight(eyes, places, walls)
    np.testing.assert_array_equal(got, wanted)
    assert 0.02 < got.mean() < 0.9


def test_a_ray_that_leaves_the_map_has_no_end():
    place = Cells(np.zeros((4, 4), bool), np.ones((4, 4), bool), 1.0)
    got = place.reach(np.array([[1.5, 1.5]] * 2), np.array([[1.0, 0.0], [0.0, -1.0]]))
    np.testing.assert_array_equal(got, np.inf)


def test_junctions_of_a_room_of_cells_are_those_of_its_walls():
    free = np.pad(np.ones((60, 40), bool), 1)
    place = Cells(~free, free, 0.1)
    inner = place.junctions[place.holds(place.junctions)] - 0.1
    for wanted in ROOM.junctions:
        assert np.hypot(*(inner - wanted).T).min() < 0.02
    gap = np.hypot(*np.moveaxis(inner[:, None] - ROOM.junctions, -1, 0)).min(axis=1)
    assert gap.max() < 0.05


def test_neighbouring_hits_are_one_wall_unless_far_apart():
    spec = GridSpec(x_max=1.0, x_min=0.0, y_half=0.5)
    ends = np.array([[0.55, -0.25], [0.55, -0.05], [0.55, 0.45], [9.0, 9.0]])
    cells = thinning.max_walls(ends, np.array([True, True, True, False]), spec)
    assert set(map(tuple, np.argwhere(cells))) == {(5, 2), (5, 3), (5, 4), (5, 9)}


def test_thinning_finds_the_crossing_of_two_corridors_and_no_spur():
    if thinning.missing():
        pytest.skip("scikit-image or sknw is not installed")
    free = np.zeros((41, 41), bool)
    free[17:24, 2:39] = free[2:39, 17:24] = True
    free[24:26, 8] = True  # a niche
    place, clearance = thinning.junctions(free)
    np.testing.assert_allclose(place, [[20.0, 20.0]], atol=1.0)
    np.testing.assert_allclose(clearance, np.hypot(4, 4) - 0.5)


def test_tiny_runs_without_map_and_peer_give_null(tmp_path, monkeypatch, capsys):
    def blind(key, worlds, case):
        nothing = lambda at: seen(at.poses, np.zeros((len(at.poses), 3, 2)))
        hidden = lambda at: nothing(at)._replace(
            valid=np.zeros((len(at.poses), 3), bool), trusted=np.zeros((len(at.poses), 3), bool)
        )
        return {name: [(at, hidden(at)) for at in scenes] for name, scenes in worlds.items()}

    monkeypatch.setattr(repeatability, "look", blind)
    monkeypatch.setattr(repeatability, "Drawn", lambda walls: ROOM)  # truth takes a while
    monkeypatch.setattr(repeatability, "WILLOW", tmp_path / "none.yaml")
    monkeypatch.setattr(thinning, "NEEDS", ("math", "no.such.module"))
    repeatability.main(["--out", str(tmp_path), "--pairs", "1", "--plans", "1"])
    numbers = json.loads((tmp_path / "repeatability.json").read_text())
    assert numbers["not_installed"] == ["no.such.module"] and "none.yaml" in str(
        numbers["left_out"]
    )
    assert len(numbers["rows"]) == 2 * 3 * 2 * 2  # labels, noises, worlds, kinds
    keys = "world labels kind noise_m repeatability spurious spread_m nees per_scan checks".split()
    for row in numbers["rows"]:
        assert set(keys) <= set(row)
        assert row["checks"] == 0 and row["repeatability"] is None and row["per_scan"] == 0
    for name, bins in (("by_distance", 3), ("by_heading", 3), ("by_step", 2)):
        assert len(numbers[name]) == bins * 2 * 2
    assert (tmp_path / "repeatability.png").read_bytes().startswith(b"\x89PNG")
    told = capsys.readouterr().out
    assert "without thinning" in told and "without willow" in told
