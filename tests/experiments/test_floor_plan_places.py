import jax
import numpy as np
import pytest

from experiments import floor_plan_places, ground_truth
from experiments.floor_plan_places import LIDAR, Conditions
from jaxslam.core.se2_np import relative

CLEAN = Conditions(range_std=1e-6)


def scans_of(walls, poses, how, seed=0):
    rng = np.random.default_rng(seed)
    return floor_plan_places.scans_of(rng, jax.random.key(seed), walls, poses, how)


@pytest.fixture(scope="module")
def plan():
    return floor_plan_places.make_plan(np.random.default_rng(4), 2)


def test_offices_of_a_kind_look_alike_from_within(monkeypatch):
    """The robot looks into the office, with the door behind it."""
    monkeypatch.setattr(floor_plan_places, "KINDS", 1)
    walls, path = floor_plan_places.offices(np.random.default_rng(1), 3)
    inside = path[np.abs(path[:, 1]) > 0.1]
    poses = np.column_stack([inside, np.sign(inside[:, 1]) * np.pi / 2])
    scans = scans_of(walls, poses, CLEAN)
    assert len(poses) == 6 and scans.hit.all()
    for ranges in scans.ranges[1:]:
        np.testing.assert_allclose(ranges, scans.ranges[0], atol=1e-4)
    outside = np.column_stack([path[[1, 4]], [0.0, 0.0]])
    different = scans_of(walls, outside, CLEAN).ranges
    assert np.abs(different[0] - different[1]).max() > 1.0


def test_the_drive_meets_no_wall_and_comes_into_each_office(plan):
    assert ground_truth.clearance(plan.poses[:, :2], plan.walls).min() > 0.3
    inside = np.abs(plan.poses[:, 1]) > floor_plan_places.CORRIDOR / 2 + 0.5
    visits = np.flatnonzero(np.diff(inside.astype(int)) == 1)
    assert len(visits) == 4
    steps = np.hypot(*np.diff(plan.poses[:, :2], axis=0).T)
    assert steps.max() <= floor_plan_places.STEP + 1e-9


def test_conditions_are_those_of_the_scans(plan):
    poses = plan.poses[:30]
    clean = scans_of(plan.walls, poses, CLEAN)
    noisy = scans_of(plan.walls, poses, CLEAN._replace(range_std=0.05))
    both = np.asarray(clean.hit & noisy.hit)
    error = np.asarray(noisy.ranges - clean.ranges)[both]
    assert error.std() == pytest.approx(0.05, abs=4 * 0.05 / np.sqrt(2 * both.sum()))
    some = scans_of(plan.walls, poses, CLEAN._replace(missing=0.4))
    share = 1 - np.asarray(some.hit).sum() / np.asarray(clean.hit).sum()
    assert share == pytest.approx(0.4, abs=4 * np.sqrt(0.24 / np.asarray(clean.hit).sum()))
    crowd = scans_of(plan.walls, poses, CLEAN._replace(people=6))
    nearer = np.asarray(crowd.ranges < clean.ranges - 0.01)
    assert nearer.any(axis=1).mean() > 0.6 and not (crowd.ranges > clean.ranges + 0.01).any()


def test_the_range_to_a_person_is_that_of_a_disc():
    ranges = floor_plan_places._person(2.0, 1.0)
    angles = LIDAR.angle_min + LIDAR.angle_increment * np.arange(LIDAR.num_beams)
    met = np.isfinite(ranges)
    x, y = ranges[met] * np.cos(angles[met]), ranges[met] * np.sin(angles[met])
    np.testing.assert_allclose(np.hypot(x - 2.0, y - 1.0), floor_plan_places.PERSON)
    assert ranges.min() == pytest.approx(np.hypot(2, 1) - floor_plan_places.PERSON, abs=1e-3)


def test_viewpoints_are_as_far_off_the_drive_as_was_asked(plan):
    how = Conditions(offset=0.4, heading=0.7)
    poses = floor_plan_places.viewpoints(np.random.default_rng(0), plan, 20, how)
    for pose in poses:
        off = relative(plan.poses, pose)
        right = np.isclose(np.hypot(off[:, 0], off[:, 1]), 0.4) & np.isclose(abs(off[:, 2]), 0.7)
        assert right.any()
    assert ground_truth.clearance(poses[:, :2], plan.walls).min() > 0.3


def test_a_run_has_all_levels_and_repeats(monkeypatch):
    monkeypatch.setattr(floor_plan_places, "LEVELS", {"people": (0, 3)})
    found, again = (floor_plan_places.run(3, 1, 6) for _ in range(2))
    assert found == again and len(found["rows"]) == 12
    assert [row["value"] for row in found["summary"]] == [0, 3]
    for row in found["summary"]:
        some = [r for r in found["rows"] if r["value"] == row["value"]]
        accepted = [r for r in some if r["accepted"]]
        assert (row["queries"], row["accepted"]) == (6, len(accepted))
        assert row["recall"] == sum(r["right"] for r in accepted) / 6
        assert row["recall"] <= row["best_right"]
