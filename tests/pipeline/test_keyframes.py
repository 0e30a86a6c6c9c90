"""Laws of keyframes: what is chosen, composed and interpolated, against plain products of poses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.measurement import ScanMatch
from jaxslam.core.se2_np import compose, dead_reckoning, relative
from jaxslam.matching.odometry_fusion import fuse_odometry
from jaxslam.pipeline import keyframes

T = 60
DISTANCE = (0.3, 0.3)
RNG = np.random.default_rng(5)
INCREMENTS = RNG.normal([0.06, 0.0, 0.0], [0.02, 0.01, 0.06], (T, 3))
INCREMENTS[0] = 0.0
CHOSEN, _ = keyframes.choose_keyframes(DISTANCE, INCREMENTS)
NUMBERS = np.flatnonzero(CHOSEN)
HERE = np.zeros(3)


def matches_of(increments, information):
    """Matches [N] whose wheels are trusted by a half, and say the same motion less a centimetre."""
    increments = np.asarray(increments, float)
    count = len(increments)
    return ScanMatch(
        increments,
        np.broadcast_to(information, (count, 3, 3)).astype(float),
        np.linspace(0.9, 0.7, count),
        increments - [0.01, 0.0, 0.0],
        np.tile([1e-4, 2e-4, 3e-4], (count, 1)),
        np.linspace(1.0, 0.0, count),
    )


def random_information(count):
    root = RNG.normal(size=(count, 3, 3))
    return 1e4 * (root @ root.swapaxes(1, 2)) + 1e3 * np.eye(3)


def test_a_scan_is_a_keyframe_where_the_motion_since_the_last_one_exceeds_the_distance():
    poses = dead_reckoning(HERE, INCREMENTS)
    last = 0
    for t in range(1, T):
        x, y, turn = relative(poses[last], poses[t])
        far = np.hypot(x, y) > DISTANCE[0] or abs(turn) > DISTANCE[1]
        assert CHOSEN[t] == far
        last = t if far else last
    assert CHOSEN[0] and 5 < CHOSEN.sum() < T / 3
    turning = np.tile([0.0, 0.0, 0.11], (7, 1))
    assert keyframes.choose_keyframes(DISTANCE, turning)[0].tolist() == [1, 0, 0, 1, 0, 0, 1]
    assert not keyframes.choose_keyframes(DISTANCE, np.zeros((9, 3)))[0][1:].any()


@pytest.mark.parametrize("cut", [1, 7, 23, T - 1])
def test_keyframes_do_not_depend_on_the_portions_that_scans_come_in(cut):
    first, since = keyframes.choose_keyframes(DISTANCE, INCREMENTS[:cut])
    second, _ = keyframes.choose_keyframes(DISTANCE, INCREMENTS[cut:], since)
    np.testing.assert_array_equal(np.append(first, second), CHOSEN)


def test_without_a_distance_every_scan_is_a_keyframe():
    assert keyframes.choose_keyframes(None, INCREMENTS)[0].all()


@pytest.mark.parametrize("step, kept", [(0.06, DISTANCE), (0.16, DISTANCE), (0.31, None)])
def test_a_log_of_keyframes_is_taken_whole(step, kept):
    """Steps of 0.16 m make every second scan a keyframe; those of 0.31 m every scan."""
    odometry = np.tile([step, 0.0, 0.0], (100, 1))
    odometry[0] = 0.0
    assert keyframes.distance_for_log(DISTANCE, odometry) == kept
    assert keyframes.distance_for_log(None, odometry) is None
    assert keyframes.distance_for_log(DISTANCE, 0.0 * odometry) == DISTANCE  # without odometry


def test_motion_is_that_of_dead_reckoning_from_the_keyframe_before():
    poses = dead_reckoning(HERE, INCREMENTS)
    motion = keyframes.motion_since_keyframe(INCREMENTS, CHOSEN)
    for t in range(1, T):
        before = NUMBERS[NUMBERS < t][-1]
        np.testing.assert_allclose(motion[t], relative(poses[before], poses[t]), atol=1e-12)


def test_matches_between_keyframes_without_scans_between_are_kept_as_they_are():
    matches = matches_of(INCREMENTS, random_information(T))
    composed = keyframes.compose_matches(matches, np.ones(T, bool))
    jax.tree.map(np.testing.assert_array_equal, composed, matches)


def test_exact_increments_compose_to_the_exact_motion():
    poses = dead_reckoning(HERE, INCREMENTS)
    rows = slice(1, NUMBERS[-1] + 1)  # after the first scan, up to the last keyframe
    composed = keyframes.compose_matches(
        matches_of(INCREMENTS[rows], 1e4 * np.eye(3)), CHOSEN[rows]
    )
    np.testing.assert_allclose(dead_reckoning(HERE, composed.increment), poses[NUMBERS[1:]], 1e-9)
    wheels = dead_reckoning(HERE, INCREMENTS - [0.01, 0.0, 0.0])
    for k, (i, j) in enumerate(zip(NUMBERS[:-1], NUMBERS[1:], strict=True)):
        np.testing.assert_allclose(composed.expected[k], relative(wheels[i], wheels[j]), atol=1e-9)


def test_errors_in_one_submap_do_not_grow_with_the_number_of_scans():
    """Scans straight ahead, all with the same information, have that information together."""
    information = random_information(1)[0]
    matches = matches_of(np.tile([0.02, 0.0, 0.0], (12, 1)), information)
    composed = keyframes.compose_matches(matches, np.arange(12) % 6 == 5)
    np.testing.assert_allclose(composed.information, np.stack([information] * 2), rtol=1e-4)
    # Dead reckoning is summed, and the weakest scan counts.
    np.testing.assert_allclose(composed.expected_variance, 6 * matches.expected_variance[:2])
    np.testing.assert_allclose(composed.inlier_fraction, matches.inlier_fraction[[5, 11]])
    mean = [matches.odometry_weight[:6].mean(), matches.odometry_weight[6:].mean()]
    np.testing.assert_allclose(composed.odometry_weight, mean)


def test_the_covariance_is_the_mean_of_those_turned_into_the_frame_of_the_keyframe():
    information, turned = random_information(5), np.zeros(3)
    increments = RNG.normal([0.05, 0.0, 0.2], 0.02, (5, 3))
    cov = []
    for own, increment in zip(information, increments, strict=True):
        c, s = np.cos(turned[2]), np.sin(turned[2])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        cov.append(turn @ np.linalg.inv(own) @ turn.T)
        turned = compose(turned, increment)
    composed = keyframes.compose_matches(matches_of(increments, information), np.arange(5) == 4)
    np.testing.assert_allclose(np.linalg.inv(composed.information[0]), np.mean(cov, 0), rtol=2e-2)


def corridor(heading, along):
    """Information (3, 3) of a scan with this heading in a corridor along x, in its own frame."""
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return turn.T @ np.diag([along, 1e5, 1e6]) @ turn


@pytest.mark.parametrize("blind", [[0, 1, 2, 3, 4, 5], [3]])
def test_in_a_corridor_the_direction_along_is_left_to_the_wheels(blind):
    """Scans that turn, and do not see how far they come: all of them, or one."""
    turn = 0.15
    information = [corridor(turn * k, 0.0 if k in blind else 1e5) for k in range(6)]
    along = np.array([0.05, 0.0, turn])
    matches = matches_of(np.tile(along, (6, 1)), np.array(information))
    matches = matches._replace(
        increment=along + [0.02, 0.0, 0.0], expected=None, expected_variance=None
    )
    matches = matches._replace(increment=np.tile(matches.increment, (6, 1)))
    composed = keyframes.compose_matches(matches, np.arange(6) == 5)
    own = composed.information[0]
    assert own[0, 0] < 10.0 and own[1, 1] > 0.9e5 and own[2, 2] > 0.9e6
    wheels = dead_reckoning(HERE, np.tile(along, (6, 1)))[-1]
    match = jax.tree.map(lambda x: jnp.asarray(x[0]), composed)
    cov = 1e-4 * jnp.eye(3)
    fused, fused_cov = fuse_odometry(jnp.ones(()), jnp.asarray(wheels), cov, match)
    off = composed.increment[0] - wheels  # the wheels' covariance has that of an unknown mount
    assert off[0] > 0.08 and abs(fused[0] - wheels[0]) < 0.2 * off[0]
    assert abs(fused[1] - composed.increment[0, 1]) < 2e-3
    assert fused_cov[0, 0] > 0.9e-4 and fused_cov[1, 1] < 1.1e-5


def test_a_scan_without_any_information_leaves_the_increment_to_the_wheels():
    information = random_information(10)
    information[7] = 0.0
    composed = keyframes.compose_matches(
        matches_of(INCREMENTS[:10], information), np.arange(10) % 5 == 4
    )
    assert composed.information[0].any() and not composed.information[1].any()


KEYFRAME_POSES = dead_reckoning(np.array([3.0, -1.0, 2.8]), INCREMENTS)[CHOSEN]
BENT = KEYFRAME_POSES + RNG.normal(0.0, 0.03, KEYFRAME_POSES.shape)
MOTION = keyframes.motion_since_keyframe(INCREMENTS, CHOSEN)


def interpolated(poses):
    return keyframes.interpolate_poses(poses, CHOSEN, MOTION, INCREMENTS)


def test_poses_that_need_no_correction_are_those_of_the_matched_motion():
    want = dead_reckoning(KEYFRAME_POSES[0], INCREMENTS)
    np.testing.assert_allclose(relative(want, interpolated(KEYFRAME_POSES)), 0.0, atol=1e-9)
    found = keyframes.poses_since_keyframes(KEYFRAME_POSES, CHOSEN, MOTION)
    np.testing.assert_allclose(relative(want, found), 0.0, atol=1e-9)


def test_interpolated_poses_pass_through_the_keyframes_without_a_jump():
    """The last step to a keyframe differs from the matched one by its share of the correction."""
    poses = interpolated(BENT)
    np.testing.assert_array_equal(poses[CHOSEN], BENT)
    online = keyframes.poses_since_keyframes(BENT, CHOSEN, MOTION)
    np.testing.assert_array_equal(online[CHOSEN], BENT)
    off = np.abs(relative(INCREMENTS[1:], relative(poses[:-1], poses[1:])))
    jumps = np.abs(relative(INCREMENTS[1:], relative(online[:-1], online[1:])))
    assert off.max() < 0.5 * jumps.max()
    last = NUMBERS[-1]
    np.testing.assert_allclose(poses[last:], online[last:], atol=1e-12)
    assert T - 1 > last  # there are scans after it


def test_the_correction_is_shared_out_by_the_path_driven():
    """Straight ahead, of twice the matched length: every point is moved in proportion."""
    steps = np.array([0.0, 0.05, 0.1, 0.03, 0.15])
    increments = np.stack([steps, 0 * steps, 0 * steps], axis=1)
    chosen = np.array([1, 0, 0, 0, 1], bool)
    motion = keyframes.motion_since_keyframe(increments, chosen)
    ends = np.array([[1.0, 2.0, 0.0], [1.0 + 2 * steps.sum(), 2.0, 0.0]])
    poses = keyframes.interpolate_poses(ends, chosen, motion, increments)
    np.testing.assert_allclose(poses[:, 0], 1.0 + 2 * np.cumsum(steps), atol=1e-12)


def test_interpolated_poses_turn_with_the_map():
    frame = np.array([20.0, -7.0, 2.5])
    turned = compose(frame, interpolated(BENT))
    np.testing.assert_allclose(interpolated(compose(frame, BENT)), turned, atol=1e-9)


def test_standing_still_between_keyframes_divides_by_nothing():
    still = np.zeros((4, 3))
    chosen = np.array([1, 0, 0, 1], bool)
    poses = keyframes.interpolate_poses(np.zeros((2, 3)), chosen, still, still)
    np.testing.assert_array_equal(poses, 0.0)
