"""Places that a drive shows twice, though it has them metres apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from simulated_scans import LIDAR, item, scans_of

from jaxslam.core.se2_np import compose, dead_reckoning, increments, relative
from jaxslam.matching.map_places import JoinSpec, ScanMap
from jaxslam.matching.revisits import find_revisits
from jaxslam.simulation.worlds import World, outline

SPEC = JoinSpec()
# A ring of corridors around a block, with niches.
RING = [(0, 0, 14, 10), (5, -0.6, 7, 0), (14, 4, 14.8, 5), (4, 10, 5, 11), (-0.5, 6, 0, 8)]
RING_BLOCKS = [(2, 2, 12, 8), (9, 0, 9.4, 0.4), (1.7, 4.0, 2.0, 4.6)]
RING_CORNERS = np.array([(1, 1), (13, 1), (13, 9), (1, 9)], float)
# A long ring with the same niche every three metres.
COMB = [(0, 0, 40, 6), *[(x, -0.5, x + 1, 0) for x in np.arange(3.5, 36, 3)]]
COMB_CORNERS = np.array([(1, 1), (39, 1), (39, 5), (1, 5)], float)


def laps(corners, rounds, step=0.4):
    """Poses (T, 3) of a drive around corners, which turns on the spot at each."""
    poses = []
    for leg in range(int(4 * rounds)):
        start, end = corners[leg % 4], corners[(leg + 1) % 4]
        heading = leg * np.pi / 2
        for part in np.arange(0.0, 1.0, step / np.hypot(*(end - start))):
            poses.append((*(start + part * (end - start)), heading))
        poses += [(*end, heading + turn) for turn in (0.5, 1.0)]
    return np.array(poses)


def map_of(boxes, blocks, poses, believed=None):
    """The scans from poses, at the poses that a drive has of them."""
    walls = World(jnp.asarray(outline(boxes, blocks)))
    scans = jax.tree.map(np.asarray, scans_of(walls, jnp.asarray(poses), LIDAR.range_std))
    return ScanMap(LIDAR, poses if believed is None else believed, scans)


def with_error(poses, at, error):
    """The poses of a drive that is wrong by `error` at one step."""
    steps = increments(poses)
    steps[at] = compose(steps[at], np.array(error))
    return dead_reckoning(poses[0], steps)


@pytest.mark.parametrize("error", [(-2.5, 0.0, 0.0), (0.0, 0.0, 0.5)])
def test_places_are_found_from_which_the_error_follows(error):
    poses, at = laps(RING_CORNERS, 1.75), 50
    scan_map = map_of(RING, RING_BLOCKS, poses, with_error(poses, at, error))
    found = find_revisits(SPEC, scan_map)
    assert len(found.first) >= SPEC.min_places
    assert (found.first < at).all() and (found.second >= at).all()
    off = relative(found.relative_pose, relative(poses[found.first], poses[found.second]))
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.15 and np.abs(off[:, 2]).max() < 0.03


@pytest.mark.parametrize(
    "boxes, blocks, corners",
    [(RING, RING_BLOCKS, RING_CORNERS), (COMB, [(2, 2, 38, 4)], COMB_CORNERS)],
)
def test_a_drive_without_error_has_no_places_elsewhere_even_where_many_look_alike(
    boxes, blocks, corners
):
    found = find_revisits(SPEC, map_of(boxes, blocks, laps(corners, 1.75)))
    assert not len(found.first)


def test_a_drive_of_one_keyframe_or_of_bad_poses_is_no_special_case():
    poses = laps(RING_CORNERS, 1.0)[:1]
    own = map_of(RING, RING_BLOCKS, poses)
    assert not len(find_revisits(SPEC, own).first)
    with pytest.raises(ValueError, match=r"scan_map.poses are those of no keyframe"):
        find_revisits(SPEC, own._replace(poses=own.poses[:0], scans=item(own.scans, slice(0))))
