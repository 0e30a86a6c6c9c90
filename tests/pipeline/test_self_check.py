"""Whether the scans of a log agree with a saved map: only what is of the log counts."""

from types import SimpleNamespace

import numpy as np

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import compose
from jaxslam.mapping.map_consistency import check_map
from jaxslam.pipeline.self_check import check_poses, remark

LIDAR = Lidar(num_beams=181, angle_min=-np.pi / 2, angle_increment=np.pi / 180, range_max=30.0)
ROOM = np.array([8.0, 5.0])  # [m]


def drive(count=30):
    """Poses (T, 3) along a room and back, and its scans."""
    along = np.abs(np.linspace(-1.0, 1.0, count)) * 5.0 + 1.0
    poses = np.stack([along, np.full(count, 2.0), np.zeros(count)], axis=1)
    angles = LIDAR.angle_min + LIDAR.angle_increment * np.arange(LIDAR.num_beams)
    ahead = (ROOM[0] - along[:, None]) / np.cos(angles).clip(1e-9)
    side = np.where(angles > 0, ROOM[1] - 2.0, 2.0) / np.abs(np.sin(angles)).clip(1e-9)
    ranges = np.minimum(ahead, side)
    return poses, Scan(ranges, np.ones(ranges.shape, bool))


def test_without_a_saved_map_it_is_the_check_of_the_map():
    poses, scans = drive()
    piece = np.zeros(len(poses), int)
    found, expected = check_poses(LIDAR, poses, scans, piece, None), check_map(LIDAR, poses, scans)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_scans_are_numbered_as_in_the_log_and_contradict_the_saved_map_where_it_is_off():
    poses, scans = drive()
    piece, turned = np.zeros(len(poses), int), np.array([0.0, 0.8, 0.2])
    fine, wrong = (
        check_poses(LIDAR, poses, scans, piece, (SimpleNamespace(scans=scans), saved))
        for saved in (poses, compose(turned, poses))
    )
    assert fine.scan.max() < len(poses) and fine.explained.all() and not fine.warnings
    assert np.isfinite(fine.visit_contradiction).all() and not wrong.explained.all()


def test_what_only_the_saved_map_shows_does_not_count():
    poses, scans = drive()
    far = poses + [1000.0, 0.0, 0.0]
    crooked = np.concatenate([poses[:15], compose(np.array([0.0, 0.8, 0.2]), poses[15:])])
    saved = SimpleNamespace(scans=scans), crooked
    found = check_poses(LIDAR, far, scans, np.zeros(len(poses), int), saved)
    assert not found.warnings and found.explained.all()
    assert not found.wall_distance.size and not np.isfinite(found.visit_contradiction).any()
    at_rest = Scan(*(x[-1:] for x in scans))
    last = check_poses(LIDAR, crooked[-1:], at_rest, np.zeros(1, int), saved)
    assert last.metrics()["explained"] is None


def test_more_scans_that_contradict_a_map_than_usual_are_noted():
    poses, scans = drive()
    fine = check_map(LIDAR, poses, scans)
    assert remark(fine) == ()
    contradiction = np.zeros(len(fine.scan))
    contradiction[[3, 7]] = 0.6
    bent = fine._replace(visit_contradiction=contradiction)
    (note,) = remark(bent)
    assert f"between {fine.scan[3]} and {fine.scan[7]}, contradict the map" in note
    assert remark(bent._replace(warnings=(None,))) == ()
