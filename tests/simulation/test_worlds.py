import jax
import numpy as np
import pytest

from experiments import ground_truth
from jaxslam.simulation import floor_plans, worlds
from jaxslam.simulation.path_following import densify


def clearance(points, walls):
    """Distance (N,) [m] of each point (N, 2) to the nearest wall."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    offset = points[:, None] - start
    part = np.clip((offset * along).sum(-1) / (along**2).sum(-1), 0, 1)
    return np.linalg.norm(offset - part[..., None] * along, axis=-1).min(axis=1)


def length(points):
    return np.hypot(*np.diff(points, axis=0).T).sum()


def test_outline_of_overlapping_boxes_is_the_border_of_their_union():
    walls = worlds.outline([(0, 0, 2, 2), (1, 1, 3, 3)], [(0.2, 0.2, 0.6, 0.6)])
    sizes = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    assert len(walls) == 8 + 4
    np.testing.assert_allclose(sizes.sum(), 12 + 4 * 0.4)


@pytest.mark.parametrize("name", ["fig04", "fig07", "office"])
def test_axis_aligned_walls_are_closed(name):
    walls = np.asarray(worlds.named(name).walls)
    straight = walls[np.any(walls[:, :2] == walls[:, 2:], axis=1)]
    corners, count = np.unique(straight.reshape(-1, 2), axis=0, return_counts=True)
    assert np.all(count % 2 == 0), corners[count % 2 == 1]


@pytest.mark.parametrize("name", worlds.NAMES)
def test_walls_have_a_length(name):
    walls = worlds.named(name).walls
    assert walls.ndim == 2 and walls.shape[1] == 4 and np.isfinite(walls).all()
    assert np.all(np.hypot(*(walls[:, 2:] - walls[:, :2]).T) > 0.001)


@pytest.mark.parametrize("name", ["fig06a", "fig06b", "fig06c", "fig06d"])
def test_corridors_start_two_metres_and_forty_wide(name):
    walls = worlds.named(name).walls
    np.testing.assert_allclose(np.sort(walls[walls[:, 0] == -0.5][:, 1]), [-1.2, 1.2])


def test_uneven_walls_step_by_three_centimetres_at_most():
    walls = worlds.named("fig06d").walls
    assert np.abs(np.abs(walls[:, [1, 3]]) - 1.2).max() <= 0.03


def test_unknown_names_are_answered_with_the_known_ones():
    for ask in (worlds.named, worlds.waypoints, worlds.scan_poses):
        with pytest.raises(ValueError, match="nowhere.*(office|fig07)"):
            ask("nowhere")


def test_scan_poses_are_inside_and_near_each_other():
    poses = worlds.scan_poses("fig07")
    assert poses.shape == (10, 3)
    assert clearance(poses[:, :2], worlds.named("fig07").walls).min() >= 0.4
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() <= 1.5


def test_office_is_large_and_light():
    walls = worlds.named("office").walls
    size = walls.reshape(-1, 2).max(axis=0) - walls.reshape(-1, 2).min(axis=0)
    assert np.all(size >= [18, 14]) and len(walls) < 170
    along = walls[:, 2:] - walls[:, :2]
    assert np.any(np.all(np.abs(along) > 0.3, axis=1)), "no oblique wall"


def test_office_drive_is_long_clear_and_visits_positions_twice():
    path = densify(worlds.waypoints("office"))
    assert 65 <= length(path) <= 85
    assert clearance(path, worlds.named("office").walls).min() >= 0.4
    far = np.abs(np.subtract.outer(np.arange(len(path)), np.arange(len(path)))) > 200  # > 10 m
    near = np.linalg.norm(path[:, None] - path, axis=-1) < 0.1
    assert np.any(far & near, axis=1).mean() > 0.05


def plan(seed, **options):
    return floor_plans.floor_plan(jax.random.key(seed), **options).walls


@pytest.mark.parametrize("seed", range(6))
def test_a_floor_plan_is_its_keys_alone_and_its_padding_has_no_length(seed):
    walls = plan(seed)
    np.testing.assert_array_equal(walls, plan(seed))
    assert not np.array_equal(walls, plan(seed + 100))
    assert walls.shape == (floor_plans.PLAN_WALLS, 4) and np.isfinite(walls).all()
    sizes = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    count = len(ground_truth.without_padding(walls))
    assert 8 < count < floor_plans.PLAN_WALLS
    assert np.all(sizes[:count] > 1e-3) and not walls[count:].any()


@pytest.mark.parametrize("seed", range(6))
def test_no_beam_escapes_a_floor_plan(seed):
    walls = ground_truth.without_padding(plan(seed))
    low, high = walls.reshape(-1, 2).min(axis=0), walls.reshape(-1, 2).max(axis=0)
    positions = np.random.default_rng(seed).uniform(low, high, (400, 2))
    inside = ground_truth.FreeSpace(walls).contains(positions) & (clearance(positions, walls) > 0.1)
    assert inside.sum() > 50
    for position in positions[inside]:
        end = ground_truth.hits(position, np.linspace(-np.pi, np.pi, 91), walls)
        assert np.isfinite(end).all()


def test_a_floor_plan_that_needs_too_many_walls_is_refused():
    with pytest.raises(ValueError, match="size .*60.*ask for less"):
        plan(0, size=(60.0, 60.0))
