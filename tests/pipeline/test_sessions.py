"""A log that goes on in a saved map."""

import jax
import numpy as np
import pytest
from office_drive import CONFIG, LIDAR, PARAMS, office_drive, take

from jaxslam.core.se2_np import increments
from jaxslam.io import map_file
from jaxslam.pipeline import offline, sessions, to_saved_map
from jaxslam.pipeline.chunks import SLOT_BLOCK


@pytest.fixture(scope="module")
def first_session(tmp_path_factory):
    """The saved map of the first two thirds of the drive, and the drive."""
    poses, scans = office_drive()
    own = slice(0, 210)
    found = offline.run_slam(
        CONFIG, PARAMS, increments(poses[own]), take(scans, own), start=poses[0]
    )
    times = np.arange(210.0)[found.keyframes]
    saved = to_saved_map(CONFIG, PARAMS, found, times, take(scans, found.keyframes))
    path = tmp_path_factory.mktemp("map") / map_file.NAME
    map_file.write(path, saved)
    return map_file.load_map(path), poses, scans


@pytest.mark.slow
def test_a_second_session_goes_on_in_the_map_of_the_first_and_keeps_its_ids(first_session):
    saved, poses, scans = first_session
    own = slice(120, None)
    odometry = increments(poses[own])
    found = offline.run_slam(CONFIG, PARAMS, odometry, take(scans, own), saved_map=saved)
    assert not found.other_parts and "the saved map and scans 0-" in found.notes[0]
    off = found.poses[:, :2] - poses[own, :2]
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.05
    old, new = saved.topological_map.id, found.topological_map.id
    named = np.isin(old, saved.belief.id)  # other nodes go where space turns out to go on
    assert np.isin(old[named], new).mean() > 0.95 and np.isin(old, new).mean() > 0.85
    assert len(new) > len(old)
    at = {int(k): xy for k, xy in zip(new, found.topological_map.xy, strict=True)}
    moved = [
        np.hypot(*(at[int(k)] - xy))
        for k, xy, kind in zip(
            old, saved.topological_map.xy, saved.topological_map.kind, strict=True
        )
        if int(k) in at and kind < 2
    ]
    assert np.median(moved) < 0.05
    assert np.abs(found.saved_poses - saved.poses)[:, :2].max() < 0.1

    of_keyframes = take(take(scans, own), found.keyframes)
    times = np.arange(len(odometry))[found.keyframes]
    with pytest.raises(ValueError, match="saved_map is not the map that the result goes on in"):
        to_saved_map(CONFIG, PARAMS, found, times, of_keyframes)
    both = to_saved_map(CONFIG, PARAMS, found, times, of_keyframes, saved)
    assert len(both.poses) == len(saved.poses) + len(found.keyframes) == len(both.scans.hit)
    np.testing.assert_array_equal(both.scans.ranges[: len(saved.poses)], saved.scans.ranges)


@pytest.mark.slow
def test_a_building_that_is_another_one_becomes_a_map_of_its_own(first_session):
    saved, poses, scans = first_session
    mirrored = jax.tree.map(lambda x: x[:120, ::-1], scans)
    odometry = increments(poses[:120] * np.array([1.0, -1.0, -1.0]))
    found = offline.run_slam(CONFIG, PARAMS, odometry, mirrored, saved_map=saved)
    assert found.saved_poses is None and np.isfinite(found.poses).all()
    assert any("no place of the saved map was found again" in note for note in found.notes)


@pytest.mark.slow
def test_a_resumed_state_is_the_saved_one_with_free_slots(first_session):
    saved = first_session[0]
    state = sessions.resume(CONFIG, saved)
    used = len(saved.belief.id)
    assert state.belief.num_seen.size % SLOT_BLOCK == 0 and not state.belief.num_seen[used:].any()
    np.testing.assert_array_equal(state.belief.id[:used], saved.belief.id)
    np.testing.assert_allclose(state.belief.mean[: 3 + 2 * used], saved.belief.mean, atol=1e-6)
    assert int(state.belief.next_id) == int(saved.belief.next_id)
    arcs = len(saved.arcs.ends)
    np.testing.assert_array_equal(state.arcs.ends[:arcs], saved.arcs.ends)
    small = CONFIG._replace(filter=CONFIG.filter._replace(max_landmarks=3))
    with pytest.raises(ValueError, match="more than config.filter.max_landmarks = 3"):
        sessions.resume(small, saved)


@pytest.mark.slow
def test_a_map_of_another_scanner_is_refused_and_so_are_wheels(first_session):
    saved = first_session[0]
    with pytest.raises(ValueError, match="of a scanner with range_max 10, the log of one with 7"):
        sessions.check_saved_map(saved, LIDAR._replace(range_max=7.0))
    with pytest.raises(ValueError, match="saved_map has no keyframes"):
        sessions.check_saved_map(saved._replace(poses=saved.poses[:0]), LIDAR)
    with pytest.raises(ValueError, match="saved_map is int, not SavedMap"):
        sessions.check_saved_map(3, LIDAR)
    odometry, scans = np.zeros((2, 3)), take(first_session[2], slice(2))
    with pytest.raises(ValueError, match="saved_map: drives are joined by their scans"):
        offline.run_slam(CONFIG, PARAMS, odometry, scans, saved_map=saved, match_scans=False)
