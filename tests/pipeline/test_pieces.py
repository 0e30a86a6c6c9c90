"""Drives that are broken: mapped in pieces, and joined where places are found again."""

import numpy as np
import pytest
from office_drive import CONFIG, LIDAR, PARAMS, office_drive, take

from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import compose, increments, relative
from jaxslam.matching.joining import Join
from jaxslam.matching.map_places import JoinSpec, ScanMap
from jaxslam.pipeline import offline, pieces


@pytest.fixture(scope="module")
def carried():
    """A drive through the office, whose robot was carried back to where it had been before."""
    poses, scans = office_drive()
    kept = np.r_[0:170, 120 : len(poses)]
    odometry = increments(poses[kept])
    odometry[170] = 0.0
    return poses[kept], take(scans, kept), odometry, np.arange(len(kept)) == 170


@pytest.mark.slow
def test_a_robot_that_was_carried_is_found_again(carried):
    poses, scans, odometry, after_pause = carried
    found = offline.run_slam(
        CONFIG, PARAMS, odometry, scans, start=poses[0], after_pause=after_pause
    )
    assert not found.other_parts and "joined by" in found.notes[0]
    at = int(np.flatnonzero(after_pause)[0])
    np.testing.assert_array_equal(found.piece, np.arange(len(poses)) >= at)
    assert {at - 1, at} <= set(found.keyframes.tolist())
    off = found.poses[:, :2] - poses[:, :2]
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.05


@pytest.mark.slow
def test_pieces_that_share_no_place_are_maps_of_their_own(carried):
    poses, scans, odometry, _ = carried
    first = 110
    # The mirror image of the building.
    other_poses = poses[:169] * np.array([1.0, -1.0, -1.0])
    other_scans = Scan(scans.ranges[:169, ::-1], scans.hit[:169, ::-1])
    both = Scan._make(
        np.concatenate([a[:first], b]) for a, b in zip(scans, other_scans, strict=True)
    )
    odometry = np.concatenate([odometry[:first], increments(other_poses)])
    found = offline.run_slam(
        CONFIG, PARAMS, odometry, both, new_drive=np.arange(len(odometry)) == first
    )
    parts = sorted([found, *found.other_parts], key=lambda part: np.isnan(part.poses[0, 0]))
    assert len(parts) == 2 and "a map of their own" in found.notes[0]
    truths = poses[:first], other_poses
    for part, truth, own in zip(parts, truths, (slice(first), slice(first, None)), strict=True):
        assert (np.isfinite(part.poses[:, 0]) == (part.piece >= 0)).all()
        estimate = part.poses[own]
        off = relative(estimate[0], estimate) - relative(truth[0], truth)
        assert np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))) < 0.1


def test_groups_have_the_frame_of_their_first_piece(monkeypatch):
    rng = np.random.default_rng(0)
    frames = rng.uniform(-20, 20, (4, 3)) * [1, 1, 0.1]  # of the pieces, in that of the building
    sizes = (3, 9, 5, 7)
    maps = {
        k: ScanMap(LIDAR, rng.uniform(-9, 9, (n, 3)), Scan(np.ones((n, 91)), np.ones((n, 91)) > 0))
        for k, n in enumerate(sizes)
    }

    def find_join(_, first, second):
        """Pieces 1 and 3, and both of them with 0, which their sizes tell apart; never piece 2."""
        held = {9: 1, 7: 3, 16: 1, 5: 2, 3: 0, 19: 0}
        one, other = held[len(first.poses)], held[len(second.poses)]
        between = relative(frames[one], frames[other])
        return Join(between, 2 not in (one, other), 5, 9.0, 0.0, 0.0)

    monkeypatch.setattr(pieces, "find_join", find_join)
    largest, alone = pieces.group_pieces(JoinSpec(), maps, {})
    assert largest.pieces == (0, 1, 3) and alone.pieces == (2,) and len(largest.joins) == 2
    for number, frame in largest.frames.items():
        np.testing.assert_allclose(frame, relative(frames[0], frames[number]), atol=1e-9)
    together = pieces.group_map(maps, largest)
    expected = [compose(relative(frames[0], frames[k]), maps[k].poses) for k in (0, 1, 3)]
    np.testing.assert_allclose(together.poses, np.concatenate(expected), atol=1e-9)
    assert together.scans.hit.shape == (19, 91)
