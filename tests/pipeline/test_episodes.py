import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_filter

from jaxslam.core.episode import Episode
from jaxslam.core.logs import LandmarkLog, LaserLog
from jaxslam.core.measurement import Measurement, ScanMatch
from jaxslam.core.types import JUNCTION
from jaxslam.filtering import measurement_model, slam_filter
from jaxslam.filtering.config import FilterConfig, init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract, lidar
from jaxslam.io import carmen
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import ray_casting, worlds
from jaxslam.simulation.worlds import World
from jaxslam.tuning import losses

SCANS, FIRST = 7, 2  # of a recording, and the first with a reference
LIDAR = carmen.half_circle_lidar(91, 10.0)
LOSSES = tuple(loss for loss in losses.BY_NAME.values() if not losses.comparisons(loss))


def landmark_log(seed, steps=9, most=3, landmarks=4):
    """A drive of a robot that sees up to `most` of its landmarks, with noise."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-4.0, 4.0, (landmarks, 2))
    motion = rng.normal([0.4, 0.0, 0.2], 0.05, (steps, 3)) * (np.arange(steps) > 0)[:, None]
    truth, polar = [np.array([1.0, -2.0, 0.5])], np.zeros((steps, most, 2), np.float32)
    valid, which = np.zeros((steps, most), bool), np.full((steps, most), -1, np.int32)
    for t in range(steps):
        if t:
            truth.append(reference_filter.compose(truth[-1], motion[t] + rng.normal(0, 0.02, 3)))
        for k, i in enumerate(rng.permutation(landmarks)[: rng.integers(0, most + 1)]):
            seen, _ = reference_filter.observe(np.append(truth[t], positions), i, JUNCTION)
            polar[t, k], valid[t, k], which[t, k] = seen + rng.normal(0, 0.02, 2), True, i
    return LandmarkLog(
        times=np.arange(steps, dtype=float),
        odometry=motion,
        range_bearing=polar,
        valid=valid,
        landmark_index=which,
        truth=np.array(truth),
        truth_mask=rng.random(steps) < 0.8,
        landmark_positions=positions,
        landmark_names=np.arange(landmarks, dtype=np.int32) + 6,
        num_skipped=0,
    )


def odom_poses_of(poses):
    """Poses by odometry that begins elsewhere and drifts."""
    part = np.arange(len(poses)) / len(poses)
    drift = np.stack([0.1 * part, 0.3 * part**2, 0.1 * part], axis=1)
    return np.array([reference_filter.compose([3.0, -2.0, 2.0], p) for p in poses + drift])


@pytest.fixture(scope="module")
def recording():
    """Scans in the southern corridor of the office."""
    part = np.linspace(0.0, 1.0, SCANS)
    poses = np.stack([1.0 + 2.0 * part, 0.9 + 0.0 * part, 0.3 * np.sin(6 * part)], axis=1)
    walls = World(jnp.asarray(worlds.named("office").walls))
    cast = jax.jit(jax.vmap(lambda pose: ray_casting.cast(LIDAR, walls, pose).ranges))
    ranges = cast(jnp.asarray(poses))
    times, odom_poses = 0.5 + np.arange(SCANS), odom_poses_of(poses)
    ranges = np.where(np.arange(91) % 30 == 7, np.inf, np.asarray(ranges))
    ranges = ranges.astype(np.float32)
    return LaserLog(times, odom_poses, ranges, LIDAR, 0, times, odom_poses), poses


@pytest.fixture(scope="module")
def scan_log(recording):
    """The recording as an episode, with a reference for some scans, whose clock is a bit off."""
    drive, poses = recording
    some = np.array([FIRST, FIRST + 1, FIRST + 3])
    extra = np.array([[9.0, 9.0, 9.0]])
    times = np.append(drive.times[some] + [0.01, -0.02, 0.0], drive.times[1] + 0.4)
    known = np.concatenate([poses[some], extra])
    return episodes.episode_from_laser_log(CONFIG, drive, (times, known)), some


CONFIG = Config.for_lidar(LIDAR, filter=FilterConfig(max_landmarks=12))


@pytest.mark.parametrize("seed", range(3))
def test_features_of_a_landmark_log_are_those_of_a_slow_version(seed):
    drive = landmark_log(seed)
    log = episodes.episode_from_landmark_log(drive)
    np.testing.assert_array_equal(log.landmark_ids, drive.landmark_index)
    np.testing.assert_array_equal(log.features.valid, drive.valid)
    np.testing.assert_array_equal(log.truth_mask, drive.truth_mask)
    np.testing.assert_array_equal(log.truth, drive.truth)
    np.testing.assert_array_equal(log.odometry, drive.odometry)
    assert (log.features.kind == JUNCTION).all()
    for t, k in np.ndindex(drive.valid.shape):
        xy, cov = np.zeros(2), np.zeros((2, 2))
        if drive.valid[t, k]:
            r, bearing = map(float, drive.range_bearing[t, k])
            xy = r * np.array([math.cos(bearing), math.sin(bearing)])
            cov = (episodes.RANGE_STD_FRACTION * r) ** 2 * np.outer(xy / r, xy / r)
        np.testing.assert_allclose(log.features.xy[t, k], xy, rtol=1e-12)
        np.testing.assert_allclose(log.features.cov[t, k], cov, rtol=1e-12, atol=1e-18)


def test_the_std_of_a_measured_range_is_a_fraction_of_it_and_that_of_its_bearing_is_zero():
    drive = landmark_log(0)
    log = episodes.episode_from_landmark_log(drive)
    polar_cov = jax.vmap(measurement_model.polar_cov)(
        jnp.asarray(log.features.xy[drive.valid]), jnp.asarray(log.features.cov[drive.valid])
    )
    expected = np.zeros(polar_cov.shape)
    measured = drive.range_bearing[drive.valid][:, 0].astype(float)
    expected[:, 0, 0] = (episodes.RANGE_STD_FRACTION * measured) ** 2
    np.testing.assert_allclose(polar_cov, expected, atol=1e-15)
    assert expected.max() > 1e-4


def test_logs_are_in_the_precision_of_jax():
    for log in (
        episodes.episode_from_landmark_log(landmark_log(0)),
        episodes.stack_episodes([episodes.episode_from_landmark_log(landmark_log(0))]),
    ):
        leaves = jax.tree.leaves(log)
        assert all(type(leaf) is np.ndarray for leaf in leaves)
        assert {leaf.dtype.name for leaf in leaves} == {"float64", "int32", "bool"}
    with jax.enable_x64(False):
        leaves = jax.tree.leaves(episodes.episode_from_landmark_log(landmark_log(0)))
    assert {leaf.dtype.name for leaf in leaves} == {"float32", "int32", "bool"}


def test_a_recording_begins_at_its_first_reference(recording, scan_log):
    (_, poses), (log, some) = recording, scan_log
    assert {len(leaf) for leaf in jax.tree.leaves(log)} == {SCANS - FIRST}
    assert log.landmark_ids is None
    has_truth = np.isin(np.arange(FIRST, SCANS), some)
    np.testing.assert_array_equal(log.truth_mask, has_truth)
    np.testing.assert_array_equal(log.truth[has_truth], poses[some])
    assert not log.truth[~has_truth].any() and has_truth[0]


def test_increments_of_a_recording_compose_to_its_odometry_poses(recording, scan_log):
    odom_poses, log = recording[0].odom_poses[FIRST:], scan_log[0]
    assert not log.odometry[0].any() and (np.abs(log.odometry[1:]).max(axis=1) > 0.1).all()
    pose, chained = odom_poses[0], [odom_poses[0]]
    for increment in log.odometry[1:]:
        pose = reference_filter.compose(pose, increment)
        chained.append(pose)
    off = np.array(chained) - odom_poses
    np.testing.assert_allclose(off[:, :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.sin(off[:, 2] / 2), 0.0, atol=1e-12)


def test_features_of_a_recording_are_those_of_each_scan(recording, scan_log):
    ranges, log = recording[0].ranges, scan_log[0]
    extract_one = jax.jit(extract.extract_features, static_argnums=0)
    for t in range(SCANS - FIRST):
        expected = extract_one(
            CONFIG.frontend, lidar.to_scan(LIDAR, jnp.asarray(ranges[FIRST + t], float))
        )
        leaves = map(jax.tree.leaves, (log.features, expected))
        for a, b in zip(*leaves, strict=True):
            np.testing.assert_allclose(a[t], b, rtol=1e-9, atol=1e-9)
    assert (log.features.valid.sum(axis=1) >= 2).all()


def test_a_recording_without_reference_begins_at_its_first_scan(recording, scan_log, monkeypatch):
    whole = jax.tree.map(lambda x: np.zeros((SCANS, *x.shape[1:]), x.dtype), scan_log[0].features)
    monkeypatch.setattr(episodes, "extract_all", lambda *_: whole)
    log = episodes.episode_from_laser_log(CONFIG, recording[0])
    assert len(log.truth) == len(log.odometry) == SCANS
    assert not log.truth.any() and not log.truth_mask.any() and not log.odometry[0].any()
    np.testing.assert_allclose(log.odometry[FIRST + 1 :], scan_log[0].odometry[1:], atol=1e-12)


@pytest.mark.parametrize("shift, count", [(1e6, SCANS), (0.25, SCANS), (0.0, 0)])
def test_a_reference_of_another_time_is_none(recording, shift, count):
    drive, poses = recording
    known = drive.times[:count] + shift, poses[:count]
    with pytest.raises(ValueError, match="no pose at the time of a scan"):
        episodes.episode_from_laser_log(CONFIG, drive, known)


@jax.jit
def filtered(log):
    """Info of a landmark log, its three losses, and the gradient of their sum in the noise."""

    def run(log_params):
        params = jax.tree.map(jnp.exp, log_params)
        start = init(LANDMARK_CONFIG.filter, log.truth[0])
        measurements = Measurement(log.odometry, log.features, log.landmark_ids)
        _, info = slam_filter.run_filter(LANDMARK_CONFIG.filter, params, start, measurements)
        return jnp.stack([loss(info, log) for loss in LOSSES]), info

    log_params = jax.tree.map(jnp.log, NoiseParams.for_landmark_sensor())
    value, back, info = jax.vjp(run, log_params, has_aux=True)
    return info, value, back(jnp.ones(len(LOSSES)))[0]


LANDMARK_CONFIG = Config(
    filter=FilterConfig(max_landmarks=4, max_updates=5, max_new=5, landmark_kinds=(JUNCTION,))
)


def take(logs, index):
    return jax.tree.map(lambda x: x[index], logs)


def check_same(short, long, steps):
    """Info of a log and of the same log with padding."""
    for name, a, b in zip(short._fields, short, long, strict=True):
        if a is None:  # an option that is off
            continue
        b = b[:steps]
        b = b[:, : a.shape[1]] if name in ("slot", "id", "used") else b
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.fixture(scope="module")
def pair():
    """Two landmark logs, one shorter and with fewer measurements a step; and both stacked."""
    few, many = landmark_log(1, steps=6, most=2), landmark_log(2, steps=9, most=5)
    few = few._replace(truth_mask=np.array([True, True, False, True, True, True]))
    both = [episodes.episode_from_landmark_log(one) for one in (few, many)]
    return both, episodes.stack_episodes(both)


@pytest.mark.slow
def test_padding_changes_nothing_of_a_drive(pair):
    (short, long), both = pair
    assert both.odometry.shape == (2, 9, 3) and both.landmark_ids.shape == (2, 9, 5)
    info, value, gradient = filtered(short)
    padded, same_value, same_gradient = filtered(take(both, 0))
    check_same(info, padded, 6)
    np.testing.assert_allclose(same_value, value, rtol=1e-9)
    for a, b in zip(*map(jax.tree.leaves, (gradient, same_gradient)), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-7, atol=1e-12)
    assert np.isfinite(value).all() and np.abs(gradient.odometry_coefficients).min() > 0.0
    assert info.used.sum() >= 4 and not padded.used[6:].any() and not padded.dof[6:].any()
    np.testing.assert_array_equal(padded.pose[6:], np.tile(padded.pose[5], (3, 1)))
    np.testing.assert_array_equal(padded.pose_cov[6:], np.tile(padded.pose_cov[5], (3, 1, 1)))
    last = take(both, 1)._replace(num_steps=None)
    for a, b in zip(jax.tree.leaves(long), jax.tree.leaves(last), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_padding_changes_nothing_where_all_poses_are_known(pair):
    (short, long), _ = pair
    both = episodes.stack_episodes([short._replace(truth_mask=None), long])
    np.testing.assert_array_equal(both.truth_mask[0], np.arange(9) < 6)
    value = filtered(short._replace(truth_mask=np.ones(6, bool)))[1]
    np.testing.assert_allclose(filtered(take(both, 0))[1], value, rtol=1e-9)


@pytest.mark.slow
def test_padding_changes_nothing_of_scans(scan_log):
    """A filter does not depend on later scans: alone, the log has the info of a longer one."""
    log, steps = scan_log[0], SCANS - FIRST
    longer = jax.tree.map(lambda x: np.concatenate([x, x[::-1]]), log)
    both = episodes.stack_episodes([log, longer])

    def run(one):
        start, params = init(CONFIG.filter, one.truth[0]), NoiseParams.for_laser_log()
        measurements = Measurement(one.odometry, one.features)
        info = slam_filter.run_filter(CONFIG.filter, params, start, measurements)[1]
        return jax.tree.map(np.asarray, info)

    @jax.jit
    def losses_of(info, log):
        return [loss(info, log) for loss in LOSSES]

    info, padded = jax.tree.map(lambda x: x[:steps], run(longer)), run(take(both, 0))
    check_same(info, padded, steps)
    assert info.used.sum() > 4
    alone = np.array(losses_of(info, log))
    assert alone.all()
    np.testing.assert_allclose(losses_of(padded, take(both, 0)), alone, rtol=1e-9)


def test_padding_prunes_no_landmarks(scan_log):
    """Thirty real scans without a junction that is in plain view would prune it."""
    log = scan_log[0]
    still = np.zeros((30, 3), log.odometry.dtype)
    longer = Episode(
        np.concatenate([log.truth, still]), np.concatenate([log.odometry, still]), log.features
    )
    none = jax.tree.map(lambda x: np.zeros_like(np.repeat(x[:1], 30, axis=0)), log.features)
    blank = jax.tree.map(lambda *x: np.concatenate(x), log.features, none)
    both = episodes.stack_episodes([log, longer._replace(features=blank)])
    params = NoiseParams.for_laser_log()
    alone = episodes.filter_episode(CONFIG.filter, params, log)
    found = episodes.filter_episode(CONFIG.filter, params, take(both, 0))
    assert int(found.num_landmarks) == int(alone.num_landmarks) > 1
    assert int(found.num_steps) == len(log.truth)


def test_stacked_padding_is_blank(pair):
    both = pair[1]
    assert not both.truth_mask[0, 6:].any() and not both.odometry[0, 6:].any()
    assert both.num_steps.tolist() == [6, 9]
    valid = both.features.valid[0]
    assert not valid[6:].any() and not valid[:, 2:].any()
    assert (both.landmark_ids[0, 6:] == -1).all() and (both.landmark_ids[0, :, 2:] == -1).all()


def test_episodes_of_different_kinds_are_not_stacked(pair, scan_log):
    with pytest.raises(ValueError, match="episodes is empty"):
        episodes.stack_episodes([])
    for wrong in (pair[0][0], [1]):
        with pytest.raises(ValueError, match="not a list of records of type Episode"):
            episodes.stack_episodes(wrong)
    for mixed in ([pair[0][0], scan_log[0]], [scan_log[0], pair[0][0]]):
        with pytest.raises(ValueError, match="with and without `landmark_ids`"):
            episodes.stack_episodes(mixed)


def test_a_filter_of_a_landmark_log_has_capacity_for_all_landmarks():
    drives = [landmark_log(0, most=2, landmarks=7), landmark_log(1, most=5, landmarks=6)]
    config = episodes.landmark_log_config(drives).filter
    assert (config.max_landmarks, config.max_updates, config.max_new) == (7, 5, 5)
    assert config.landmark_kinds == (JUNCTION,) and config.linearisation == "invariant"


def test_arrays_make_the_episode_of_a_landmark_log():
    drive = landmark_log(3)
    expected = episodes.episode_from_landmark_log(drive)
    junk = np.where(drive.valid[..., None], drive.range_bearing, np.nan)
    truth = np.where(drive.truth_mask[:, None], drive.truth, np.nan)
    truth[0] = drive.truth[0]
    found = episodes.episode_from_arrays(drive.odometry, junk, drive.landmark_index, truth)
    mask = drive.truth_mask | (np.arange(len(truth)) == 0)
    expected = expected._replace(
        truth=np.where(mask[:, None], expected.truth, 0.0), truth_mask=mask
    )
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    blind = episodes.episode_from_arrays(drive.odometry, junk, drive.landmark_index)
    assert not blind.truth.any() and not blind.truth_mask.any()


@pytest.mark.parametrize("convert", [np.asarray, np.float32, jnp.asarray, np.ndarray.tolist])
def test_lists_and_arrays_of_either_precision_make_the_same_episode(convert):
    drive = landmark_log(3)
    values = [drive.odometry, drive.range_bearing, drive.truth]
    odometry, polar, truth = (np.float32(x).astype(float) for x in values)
    expected = episodes.episode_from_arrays(odometry, polar, drive.landmark_index, truth)
    ids = drive.landmark_index.tolist()
    found = episodes.episode_from_arrays(convert(odometry), convert(polar), ids, convert(truth))
    jax.tree.map(np.testing.assert_array_equal, found, expected)


ODOMETRY, POLAR, IDS = np.zeros((3, 3)), np.ones((3, 2, 2)), np.array([[0, 1], [1, -1], [2, 0]])
FAR = np.stack([np.arange(40) * 0.3, np.zeros(40), np.zeros(40)], axis=1)


@pytest.mark.parametrize(
    "changes, line",
    [
        ({"odometry": ODOMETRY[:, :2]}, r"odometry is float64 \(3, 2\), not \(T, 3\)"),
        ({"odometry": ODOMETRY + 1.0}, r"odometry\[0\] is .*, not zero: .*increments\(poses\)"),
        ({"odometry": FAR}, "odometry looks like absolute poses: .* 11.7 m"),
        ({"odometry": ODOMETRY * np.nan}, r"odometry\[0\] is .*, which is not finite"),
        ({"odometry": "abc"}, "odometry is <U3 .*, not numbers"),
        ({"odometry": [[0.0], [0.0, 1.0]]}, "odometry is not an array: its parts differ in shape"),
        ({"odometry": np.zeros((0, 3))}, "odometry has no rows"),
        ({"range_bearing": POLAR[:2]}, r"range_bearing is float64 \(2, 2, 2\), not \(3, M, 2\)"),
        ({"range_bearing": -POLAR}, "range_bearing holds a range that is not above zero"),
        ({"range_bearing": POLAR * np.nan}, "range_bearing holds a range .*not finite"),
        ({"range_bearing": 90.0 * POLAR}, "more than a turn; it is in radians"),
        ({"landmark_ids": IDS[:, :1]}, r"landmark_ids is int64 \(3, 1\), not integer \(3, 2\)"),
        ({"landmark_ids": IDS * 1.0}, "landmark_ids is float64"),
        ({"landmark_ids": IDS - 1}, "landmark_ids holds -2, not an index or -1"),
        ({"truth": ODOMETRY[:2]}, r"truth is float64 \(2, 3\), not \(3, 3\)"),
        ({"truth": ODOMETRY * np.nan}, r"truth\[0\] is not finite"),
    ],
)
def test_arrays_that_are_no_episode_are_refused(changes, line):
    given = {"odometry": ODOMETRY, "range_bearing": POLAR, "landmark_ids": IDS, "truth": None}
    with pytest.raises(ValueError, match=line):
        episodes.episode_from_arrays(**given | changes)


@pytest.fixture(scope="module")
def both(pair):
    return pair[1]


def filter_both(episode, config=LANDMARK_CONFIG, params=None):
    params = NoiseParams.for_landmark_sensor() if params is None else params
    return episodes.filter_episodes(config, params, episode)


def test_numpy_and_jax_episodes_give_the_same_result(both):
    expected = filter_both(both)
    double = jax.tree.map(lambda x: x.astype(float) if x.dtype.kind == "f" else x, both)
    lists = both._replace(odometry=both.odometry.tolist())
    for given in (jax.tree.map(jnp.asarray, both), double, lists):
        jax.tree.map(np.testing.assert_array_equal, filter_both(given), expected)
    singles = [take(both, k)._replace(num_steps=None) for k in range(2)]
    shorter = jax.tree.map(lambda x: x[:6], singles[0])
    jax.tree.map(np.testing.assert_array_equal, filter_both([shorter, singles[1]]), expected)
    numbers = NoiseParams(*(x if x is None else x.tolist() for x in PARAMS))
    jax.tree.map(np.testing.assert_array_equal, filter_both(both, params=numbers), expected)
    assert expected.finite.all() and expected.estimate.shape == (2, 9, 3)


PARAMS = NoiseParams.for_landmark_sensor()
SMALL = LANDMARK_CONFIG._replace(filter=LANDMARK_CONFIG.filter._replace(max_landmarks=2))
WRONG = LANDMARK_CONFIG._replace(filter=LANDMARK_CONFIG.filter._replace(linearisation="mine"))


@pytest.mark.parametrize(
    "change, options, line",
    [
        (
            lambda e: take(e, 0),
            {},
            r"episodes.odometry is float64 \(9, 3\), not floating \(B, T, 3",
        ),
        (lambda e: [e, 1], {}, "episodes is list, not Episode or a list of them"),
        (lambda e: [], {}, "episodes is empty"),
        (lambda e: [e], {}, r"odometry is float64 \(1, 2, 9, 3\), not floating \(B, T, 3\)"),
        (lambda e: e._replace(truth=e.truth[:1]), {}, "episodes.truth is float64"),
        (lambda e: e, {"config": LANDMARK_CONFIG.filter}, "config is FilterConfig, not Config"),
        (lambda e: e, {"config": WRONG}, "'mine'"),
        (lambda e: e, {"config": SMALL}, "landmark_ids holds 3, but .*max_landmarks is 2"),
        (lambda e: e, {"params": (1.0, 2.0)}, "params is tuple, not NoiseParams"),
        (
            lambda e: e._replace(scan_matches=ScanMatch(e.odometry, np.zeros((2, 9, 3, 3)), 0.0)),
            {},
            r"scan_match_std_scale is None.*for_laser_log\(match_scans=True\)",
        ),
    ],
)
def test_episodes_that_do_not_fit_are_refused(both, change, options, line):
    with pytest.raises(ValueError, match=line):
        filter_both(change(both), **options)


def test_a_log_of_another_scanner_is_refused(recording):
    other = Config.for_lidar(carmen.half_circle_lidar(181, 10.0))
    with pytest.raises(ValueError, match="laser_log has 91 beams, config.frontend.lidar 181"):
        episodes.episode_from_laser_log(other, recording[0])
