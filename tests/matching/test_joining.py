import jax
import jax.numpy as jnp
import numpy as np
import pytest
from simulated_scans import LIDAR, item, scans_of

from jaxslam.core.se2_np import compose, relative, transform
from jaxslam.matching.joining import find_join
from jaxslam.matching.map_places import (
    FoundPlaces,
    JoinSpec,
    ScanMap,
    consistent_sets,
    fit_transform,
)
from jaxslam.simulation import path_following, worlds

SPEC = JoinSpec()
FRAME = np.array([-31.0, 12.0, 2.2])


def map_of(first, last, step=0.5):
    """The part of the drive through the office between two fractions of its length."""
    path = path_following.densify(worlds.waypoints("office"))
    poses = path_following.poses_along(path, step)
    poses = poses[int(first * len(poses)) : int(last * len(poses))]
    scans = scans_of(worlds.named("office"), jnp.asarray(poses), LIDAR.range_std, int(100 * first))
    return ScanMap(LIDAR, poses, jax.tree.map(np.asarray, scans))


def in_other_frame(scan_map):
    return scan_map._replace(poses=compose(FRAME, scan_map.poses))


def assert_same_pose(one, other, distance, turn):
    off = relative(one, other)
    assert np.hypot(off[..., 0], off[..., 1]).max() < distance
    assert np.abs(off[..., 2]).max() < turn


@pytest.mark.slow
def test_two_drives_that_share_places_are_joined_and_by_the_right_transform():
    first, second = map_of(0.0, 0.6), map_of(0.4, 1.0)
    join = find_join(SPEC, first, in_other_frame(second))
    found = compose(join.transform, compose(FRAME, second.poses))
    assert join.accepted and join.num_places >= SPEC.min_places
    assert_same_pose(second.poses, found, 0.05, 0.01)


@pytest.mark.slow
@pytest.mark.parametrize("first, second", [((0.0, 1.0), (0.0, 1.0)), ((0.0, 0.3), (0.5, 1.0))])
def test_a_building_and_its_mirror_image_are_not_joined(first, second):
    own, other = map_of(*first), map_of(*second)
    mirrored = ScanMap(
        LIDAR,
        other.poses * np.array([1.0, -1.0, -1.0]),
        jax.tree.map(lambda x: x[:, ::-1], other.scans),
    )
    assert not find_join(SPEC, own, mirrored).accepted


def test_maps_of_two_scanners_or_without_keyframes_are_refused():
    own = map_of(0.0, 0.05)
    other = own._replace(lidar=LIDAR._replace(range_max=7.0))
    with pytest.raises(ValueError, match="first.lidar and second.lidar differ"):
        find_join(SPEC, own, other)
    none = own._replace(poses=own.poses[:0], scans=item(own.scans, slice(0)))
    with pytest.raises(ValueError, match=r"second.poses are those of no keyframe"):
        find_join(SPEC, own, none)
    with pytest.raises(ValueError, match="spec.query_spacing is 0"):
        find_join(SPEC._replace(query_spacing=0), own, own)


def test_the_transform_of_poses_is_found_whatever_their_weights():
    rng = np.random.default_rng(0)
    own = rng.uniform(-9, 9, (7, 3)) * [1, 1, 0.3]
    weight = rng.uniform(0.1, 1.0, 7)
    found = fit_transform(own, compose(FRAME, own), weight)
    np.testing.assert_allclose(found, FRAME, atol=1e-12)
    # One pose alone has a transform, by its heading.
    np.testing.assert_allclose(
        fit_transform(own[:1], compose(FRAME, own[:1]), weight[:1]), FRAME, atol=1e-12
    )


def test_no_other_transform_is_nearer_in_the_sense_of_least_squares():
    rng = np.random.default_rng(1)
    own = rng.uniform(-9, 9, (9, 3)) * [1, 1, 0.3]
    other = compose(FRAME, own) + rng.normal(0, [0.3, 0.3, 0.05], (9, 3))
    weight = rng.uniform(0.1, 1.0, 9)
    ahead = np.array([5.0, 0.0])

    def cost(frame):
        moved = compose(frame, own)
        off = transform(frame, own[:, :2]) - other[:, :2]
        tips = transform(moved * [0, 0, 1], ahead) - transform(other * [0, 0, 1], ahead)
        return weight @ np.sum(off**2 + tips**2, axis=1)

    best = fit_transform(own, other, weight)
    for step in 0.01 * np.vstack([np.eye(3), -np.eye(3)]):
        assert cost(best + step) > cost(best)


def test_the_largest_set_that_agrees_comes_first_and_a_query_counts_once():
    rng = np.random.default_rng(2)
    second = np.column_stack([np.arange(0.0, 40.0, 4.0), np.zeros(10), np.zeros(10)])
    right = compose(FRAME, second) + rng.normal(0, [0.05, 0.05, 0.01], (10, 3))
    wrong = rng.uniform(-50, 50, (10, 3)) * [1, 1, 0.06]
    again = np.repeat(compose(np.array([40.0, -3.0, -1.0]), second[:1]), 12, axis=0)
    found = FoundPlaces(
        query=np.concatenate([np.arange(10), np.arange(10), np.zeros(12, int)]),
        weight=np.full(32, 0.3),
        first=np.concatenate([right, wrong, again]),
        second=np.concatenate([second, second, np.repeat(second[:1], 12, axis=0)]),
    )
    sets = consistent_sets(SPEC, found)
    np.testing.assert_array_equal(sets[0], np.arange(10))
    assert len(sets) == SPEC.num_hypotheses
