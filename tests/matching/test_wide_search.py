import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal, multivariate_t
from simulated_scans import CORRIDOR, LIDAR, odometry_of, scans_of

from jaxslam.core import se2_np
from jaxslam.core.se2 import compose, transform
from jaxslam.frontend import lidar
from jaxslam.matching import motion_prior, oriented_points, wide_search
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.scan_matching import empty_submap, match_scans
from jaxslam.matching.wide_search import MatchedPose
from jaxslam.simulation import path_following, worlds

SPEC = ScanMatchSpec(window_scans=8)
SCANS_ONLY = SPEC._replace(use_odometry=False)
STEPS = 30
wheel_motion = jax.jit(motion_prior.wheel_motion, static_argnums=0)


@pytest.fixture(scope="module")
def drive():
    """A quarter of a metre a scan through the office, where it turns as well."""
    path = path_following.densify(worlds.waypoints("office"))
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    driven = 8.0 + 0.25 * np.arange(STEPS)
    x, y = (np.interp(driven, along, column) for column in path.T)
    ahead = [np.interp(driven + 0.3, along, column) for column in path.T]
    poses = jnp.stack([x, y, np.arctan2(ahead[1] - y, ahead[0] - x)], axis=1)
    return poses, scans_of(worlds.named("office"), poses, LIDAR.range_std)


def matches_of(spec, scans, odometry, start=None):
    """Matches of all scans, after which the robot stands still, for one length of all drives."""
    submap, count = empty_submap(spec, LIDAR), len(odometry)
    if start is not None:
        submap = submap._replace(last_pose=start)
    if more := STEPS - count:
        scans = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], more, axis=0)]), scans)
        odometry = np.concatenate([odometry, np.zeros((more, 3))])
    _, found = match_scans(spec, LIDAR, submap, scans, odometry, count)
    return jax.tree.map(lambda x: np.asarray(x)[:count], found)


def errors_of(poses, found):
    error = se2_np.relative(np.asarray(odometry_of(poses)), found.increment)
    return np.hypot(*error[:, :2].T).max(), np.abs(error[:, 2]).max()


def latched(odometry):
    """No motion for three scans, and then that of four at once, twice."""
    hurt = np.array(odometry)
    for k in (8, 19):
        whole = np.zeros(3)
        for step in hurt[k : k + 4]:
            whole = se2_np.compose(whole, step)
        hurt[k : k + 4] = 0.0
        hurt[k + 3] = whole
    return jnp.asarray(hurt)


def test_latched_wheels_do_not_move_the_scans(drive):
    poses, scans = drive
    found = matches_of(SPEC, scans, latched(odometry_of(poses)))
    distance, turn = errors_of(poses, found)
    assert distance < 0.03 and turn < 0.01
    weight = np.asarray(found.odometry_weight)
    assert (weight[[8, 9]] == 0.0).all() and weight[11] < 0.6 and weight[:7].min() == 1.0


def test_without_odometry_what_the_wheels_say_does_not_matter(drive):
    poses, scans = drive
    found = matches_of(SCANS_ONLY, scans, jnp.zeros_like(poses))
    distance, turn = errors_of(poses, found)
    assert distance < 0.03 and turn < 0.01
    other = matches_of(SCANS_ONLY, scans, jnp.ones_like(poses))
    np.testing.assert_array_equal(other.increment, found.increment)
    assert not np.asarray(found.odometry_weight).any()


def test_the_search_does_not_depend_on_the_pose_in_the_world(drive):
    poses, scans = drive
    hurt = latched(odometry_of(poses))
    once = matches_of(SPEC, scans, hurt)
    moved = matches_of(SPEC, scans, hurt, start=jnp.array([5.0, -3.0, 2.0]))
    np.testing.assert_allclose(moved.increment, once.increment, atol=1e-3)


def test_a_bare_corridor_leaves_the_position_along_it_to_the_wheels():
    """Wheels that slow down at once, in a corridor: a leap that the scans cannot deny."""
    steps = np.array([0.0] + 8 * [0.5] + 8 * [0.1])
    poses = jnp.stack([jnp.cumsum(jnp.asarray(steps)), jnp.zeros(17), jnp.zeros(17)], axis=1)
    found = matches_of(SPEC, scans_of(CORRIDOR, poses, 0.005), odometry_of(poses))
    np.testing.assert_allclose(found.increment[:, 0], steps, atol=0.06)
    information = np.asarray(found.information)[1:]
    assert (information[:, 0, 0] < 0.01 * information[:, 1, 1]).all()


def test_information_is_that_of_a_gaussian_over_both_places():
    a = np.random.default_rng(0).normal(size=(5, 3)) * 20
    match = MatchedPose(jnp.array([1.0, 2.0, 3.1]), jnp.asarray(a.T @ a), jnp.ones(()))
    other, advantage = jnp.array([1.4, 2.1, -3.1]), -0.5 * wide_search.PROBABILITY_SCALE
    p = 1.0 / (1.0 + np.exp(0.5))
    d = np.array([0.4, 0.1, 2 * np.pi - 6.2])
    cov = np.linalg.inv(a.T @ a) + p * (1 - p) * np.outer(d, d)
    found = wide_search.spread_over(match, other, jnp.asarray(advantage))
    np.testing.assert_allclose(found, np.linalg.inv(cov), rtol=1e-6)
    certain = wide_search.spread_over(match, other, jnp.asarray(-1.0))
    np.testing.assert_allclose(certain, match.information, rtol=1e-6)


def test_equal_places_are_ambiguous_rather_than_guessed():
    match = MatchedPose(jnp.zeros(3), 1e6 * jnp.eye(3), jnp.ones(()))
    found = wide_search.spread_over(match, jnp.array([0.6, 0.0, 0.0]), jnp.zeros(()))
    np.testing.assert_allclose(found[0, 0], 1.0 / 0.3**2, rtol=1e-3)
    np.testing.assert_allclose(found[1, 1], 1e6, rtol=1e-6)


@jax.jit
def following(history, step, wheels, contradicted):
    wheels = motion_prior.wheel_motion(SPEC, history, wheels, jnp.array(False))
    return motion_prior.next_history(history, wheels, step, jnp.ones(()), contradicted)


def next_history(history, step, contradicted=False, wheels=None):
    return following(history, step, step if wheels is None else wheels, jnp.array(contradicted))


def history_of(increment, count=40, contradicted=False):
    history = motion_prior.first_history()
    for k in range(count):
        step = increment + 0.005 * (k % 2)
        history = next_history(history, step, contradicted)
    return history


def test_wheels_are_trusted_less_the_more_they_are_contradicted_and_it_is_forgotten():
    wheels, moved = jnp.array([0.0, 0.0, 0.0]), jnp.array([0.3, 0.0, 0.0])
    right = motion_prior.wheel_motion(SPEC, motion_prior.first_history(), moved, jnp.array(False))
    wrong = right._replace(increment=wheels)
    assert motion_prior.contradicts(wrong, moved) and not motion_prior.contradicts(right, moved)
    history = history_of(moved, contradicted=True)
    hanging = motion_prior.wheel_motion(SPEC, history, wheels, jnp.array(False))
    expected = motion_prior.expected_motion(history, hanging)
    np.testing.assert_allclose(expected.increment, moved, atol=0.011)
    for _ in range(30):
        history = next_history(history, moved)
    good = motion_prior.wheel_motion(SPEC, history, moved + 0.01, jnp.array(False))
    assert good.outlier_probability < 0.01
    expected = motion_prior.expected_motion(history, good)
    np.testing.assert_allclose(expected.increment, moved + 0.01, atol=1e-3)


def test_a_guessed_increment_may_be_wrong_and_off_by_the_usual_change():
    history = history_of(jnp.array([0.3, 0.0, 0.0]))
    said, guessed = (
        motion_prior.wheel_motion(SPEC, history, jnp.array([0.3, 0.0, 0.0]), jnp.array(g))
        for g in (False, True)
    )
    assert said.outlier_probability == 0.0 and guessed.outlier_probability == 0.5
    change = motion_prior.change_variance(history)
    np.testing.assert_allclose(guessed.variance, said.variance + change)


@pytest.mark.parametrize("reversed_before", [False, True])
def test_the_density_of_the_pose_is_that_of_a_mixture(reversed_before):
    history = history_of(jnp.array([0.3, 0.0, 0.1]))
    if reversed_before:
        back = next_history(history, history.increment, wheels=jnp.array([-0.1, 0.0, 0.0]))
        history = history._replace(wheels_reverse=back.wheels_reverse)
    wheels = motion_prior.WheelMotion(
        jnp.array([0.1, 0.05, -0.2]), jnp.array([0.01, 0.02, 0.03]), jnp.array(0.3)
    )
    before, rng = jnp.array([2.0, -1.0, 0.7]), np.random.default_rng(0)
    found = motion_prior.pose_hypotheses(history, wheels, before)
    change = np.asarray(motion_prior.change_variance(history))
    turn = np.array([[np.cos(0.7), -np.sin(0.7), 0], [np.sin(0.7), np.cos(0.7), 0], [0, 0, 1]])
    backwards = wheels.increment * jnp.array([-1.0, 1.0, 1.0])
    unsigned = 0.0 if reversed_before else 0.01
    # Densities are compared as if a Gaussian and a t of one scale had the same peak.
    same_peak = multivariate_t(np.zeros(3), df=3).pdf(np.zeros(3)) * (2 * np.pi) ** 1.5

    def part(mean, cov, heavy):
        loc, shape = np.asarray(compose(before, mean)), turn @ cov @ turn.T
        if heavy:
            return loc, multivariate_t(loc, shape, df=3).pdf
        return loc, lambda x: same_peak * multivariate_normal(loc, shape).pdf(x)

    parts = [
        (weight, *part(mean, cov, heavy))
        for weight, mean, cov, heavy in (
            (0.7 * (1 - unsigned), wheels.increment, np.diag(wheels.variance), False),
            (0.3 * (1 - unsigned), history.increment, np.diag(change), True),
            (unsigned, backwards, np.diag(wheels.variance), False),
        )
    ]
    poses = np.asarray(before) + rng.normal(size=(20, 3)) * 0.2
    slow = np.log(sum(weight * pdf(poses) for weight, _, pdf in parts))
    peak = np.log(max(weight * pdf(loc) for weight, loc, pdf in parts))
    fast = [motion_prior.log_density(found, jnp.asarray(pose)) for pose in poses]
    np.testing.assert_allclose(fast, slow - peak, rtol=1e-3, atol=1e-3)


def test_wheels_leap_where_the_motion_changes_by_more_than_is_usual():
    step = jnp.array([0.2, 0.0, 0.05])
    history = history_of(step)
    wheels = motion_prior.wheel_motion(SPEC, history, step + 0.02, jnp.array(False))
    assert not motion_prior.leap(SPEC, history, wheels)
    leap = wheels._replace(increment=jnp.zeros(3))
    assert motion_prior.leap(SPEC, history, leap)
    assert not motion_prior.leap(SCANS_ONLY, history, leap)
    known = leap._replace(outlier_probability=jnp.ones(()))
    assert not motion_prior.leap(SPEC, history, known)
    assert not motion_prior.wrong_again(SPEC, history, known)
    wrong_of_late = history._replace(contradicted=jnp.array(0.4))
    assert motion_prior.wrong_again(SPEC, wrong_of_late, known)
    assert not motion_prior.wrong_again(SCANS_ONLY, wrong_of_late, known)
    right = known._replace(increment=step)
    assert not motion_prior.wrong_again(SPEC, wrong_of_late, right)


@pytest.fixture(scope="module")
def counted_search():
    """The search, jitted, and a list with an item for each that has looked widely."""
    searches, candidates = [], wide_search._candidates

    def counted(*given):
        jax.debug.callback(lambda: searches.append(1))
        return candidates(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wide_search, "_candidates", counted)
        yield jax.jit(wide_search.search_widely, static_argnums=(0, 1)), searches


@pytest.mark.parametrize("right", [True, False])
def test_a_quick_match_that_the_motion_before_does_not_better_is_kept_without_a_search(
    drive, counted_search, right
):
    poses, scans = drive
    submap, now = empty_submap(SPEC, LIDAR), 8
    submap, _ = match_scans(SPEC, LIDAR, submap, scans, odometry_of(poses), now)
    step = odometry_of(poses)[now]
    true = compose(submap.last_pose, step)
    wheels = motion_prior.WheelMotion(step, 0.01 * jnp.ones(3), jnp.zeros(()))
    hypotheses = motion_prior.pose_hypotheses(submap.motion, wheels, submap.last_pose)
    scan = jax.tree.map(lambda x: x[now], scans)
    points, hit = lidar.beam_ends(LIDAR, scan), scan.hit
    pose = true if right else true.at[:2].add(0.7)
    quick = MatchedPose(pose, 1e4 * jnp.eye(3), jnp.where(right, 0.95, 0.5))
    search, searches = counted_search
    searches.clear()
    given = SPEC, LIDAR, submap, hypotheses, points, hit, quick
    found = search(*given, jnp.array(True))
    jax.effects_barrier()
    assert len(searches) == (0 if right else 1)
    np.testing.assert_allclose(found.pose, true, atol=0.03)


def slow_contradicted(lidar, clouds, poses, points):
    """The same, point by point and keyframe by keyframe."""
    total = 0.0
    for point in points:
        saw, free = 0, 0
        for cloud, pose in zip(clouds, poses, strict=True):
            away = point - pose[:2]
            bearing = np.arctan2(*away[::-1]) - pose[2]
            bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
            beam = round((bearing - lidar.angle_min) / lidar.angle_increment)
            if 1 <= beam < lidar.num_beams - 1:
                around = np.hypot(*(cloud[beam - 1 : beam + 2] - pose[:2]).T)
                saw += 1
                free += np.hypot(*away) < around.min() - wide_search.FREE_MARGIN
        total += free / max(saw, 1)
    return total / len(points)


def test_contradicted_are_points_in_space_that_keyframes_saw_to_be_free(drive):
    poses, scans = (jax.tree.map(lambda x: x[:3], part) for part in drive)

    @jax.jit
    @jax.vmap
    def seen(pose, scan):
        surface = oriented_points.oriented_points(LIDAR, scan)
        ends = transform(pose, lidar.beam_ends(LIDAR, scan))
        return oriented_points.transform_points(pose, surface), ends

    surfaces, ends = seen(poses, scans)
    surfaces = surfaces._replace(valid=jnp.ones_like(surfaces.valid))
    points = np.array(ends[1, ::5])
    points[::3] = np.asarray(poses[1])[:2] + 0.5 * (points[::3] - np.asarray(poses[1])[:2])
    hit = jnp.ones(len(points), bool)
    contradicted_fraction = jax.jit(wide_search.contradicted_fraction, static_argnums=0)
    found = contradicted_fraction(LIDAR, surfaces, poses, jnp.asarray(points), hit)
    clouds = np.asarray(surfaces.points)
    expected = slow_contradicted(LIDAR, clouds, np.asarray(poses), points)
    np.testing.assert_allclose(found, expected, atol=0.02)
    assert 0.15 < expected < 0.5
    ahead = contradicted_fraction(
        LIDAR, surfaces, poses, jnp.asarray(points), jnp.arange(len(points)) % 3 != 0
    )
    assert ahead < 0.02


def test_the_scale_of_the_wheels_is_learned_where_scans_show_the_motion_ahead():
    """Against sums with the same weights and instrument, whose prior is at 1."""
    rng, history = np.random.default_rng(0), motion_prior.first_history()
    information = np.diag([4e3, 5e3, 2e4]) + np.outer([30.0, -20.0, 60.0], [30.0, -20.0, 60.0])
    total, right = motion_prior.SCALE_STD**-2, motion_prior.SCALE_STD**-2
    step = jax.jit(motion_prior.learn_scale)
    for _ in range(600):
        said = jnp.array([rng.uniform(0.1, 0.8), 0.0, rng.normal() * 0.1])
        moved = jnp.array([0.95 * said[0] + rng.normal() * 0.02, 0.0, said[2]])
        wheels = wheel_motion(SPEC, history, said, jnp.array(False))
        before = history.increment
        history = step(history, wheels, moved, jnp.asarray(information), jnp.array(True))
        history = history._replace(increment=moved)
        own = information.copy()
        own[1:, 1:] += np.diag(1.0 / np.asarray(wheels.variance)[1:])
        ahead = 1.0 / np.linalg.inv(own)[0, 0]
        ahead -= motion_prior.SURFACE_TILT_STD**2 * (information[0, 0] + information[1, 1])
        weight = 1.0 / (1.0 / ahead + float(wheels.variance[0]))
        weight *= abs(float(before[0]))
        total, right = total + weight * said[0], right + weight * moved[0]
    np.testing.assert_allclose(history.wheel_scale, right / total, rtol=1e-3)
    assert abs(history.wheel_scale - 0.95) < 0.02
    corrected = motion_prior.wheel_motion(
        SPEC, history, jnp.array([1.0, 0.1, 0.2]), jnp.array(False)
    )
    expected = np.array([1.0, 0.1, 0.2]) * [history.wheel_scale, history.wheel_scale, 1.0]
    np.testing.assert_allclose(corrected.increment, expected, rtol=1e-6)


@pytest.mark.parametrize("case", ["corridor", "not used"])
def test_a_corridor_and_wheels_that_are_wrong_teach_no_scale(case):
    history, said = motion_prior.first_history(), jnp.array([0.5, 0.0, 0.0])
    wheels = motion_prior.wheel_motion(SPEC, history, said, jnp.array(False))
    tilt = 0.05
    along = np.array([np.sin(tilt), np.cos(tilt), 0.3])  # a wall whose normals are off
    information = jnp.asarray(1e4 * np.outer(along, along) + np.diag([0.0, 0.0, 1e4]))
    if case == "not used":
        information = 1e4 * jnp.eye(3)
    used = jnp.array(case == "corridor")
    found = motion_prior.learn_scale(history, wheels, said * 0.9, information, used)
    assert found.wheel_scale == 1.0 and found.scale_information == history.scale_information


@pytest.mark.slow
def test_noise_of_the_wheels_does_not_bias_their_scale():
    """Steps of 3 cm, with 1 cm of noise: least squares would have the scale a tenth too small."""
    rng, history = np.random.default_rng(1), motion_prior.first_history()
    information = jnp.asarray(np.diag([4e4, 5e3, 2e4]))
    step = jax.jit(motion_prior.learn_scale)
    true = 0.03 + 0.005 * np.sin(np.arange(8000) / 50)
    for moved, said in zip(true, true + rng.normal(size=len(true)) * 0.01, strict=True):
        wheels = wheel_motion(SPEC, history, jnp.array([said, 0.0, 0.0]), jnp.array(False))
        moved = jnp.array([moved, 0.0, 0.0])
        history = step(history, wheels, moved, information, jnp.array(True))
        history = history._replace(increment=moved)
    std = 0.01 / (0.03 * np.sqrt(len(true)))
    assert abs(history.wheel_scale - 1.0) < 5 * std < 0.05
