import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_filter

from jaxslam.core.episode import Episode
from jaxslam.core.logs import LandmarkLog, LaserLog
from jaxslam.core.measurement import Measurement
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
LOSSES = tuple(losses.BY_NAME.values())


def sightings(seed, steps=9, most=3, landmarks=4):
    """A drive of a robot that sees up to `most` of its landmarks, with noise."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-4.0, 4.0, (landmarks, 2))
    motion = rng.normal([0.4, 0.0, 0.2], 0.05, (steps, 3)) * (np.arange(steps) > 0)[:, None]
    truth, polar = [np.array([1.0, -2.0, 0.5])], np.zeros((steps, most, 2), np.float32)
    valid, which = np.zeros((steps, most), bool), np.full((steps, most), -1, np.int32)
    for t in range(steps):
        if t:
            truth.append(reference_filter.compose(truth[-1], motion[t] + rng.normal(0, 0.02, 3)))
        for k, i in enumerate(rng.permutation(landmarks)[: rng.integers(0, most + 1)]):
            seen, _ = reference_filter.observe(np.append(truth[t], places), i, JUNCTION)
            polar[t, k], valid[t, k], which[t, k] = seen + rng.normal(0, 0.02, 2), True, i
    return LandmarkLog(
        times=np.arange(steps, dtype=float),
        odometry=motion,
        range_bearing=polar,
        valid=valid,
        landmark_index=which,
        truth=np.array(truth),
        truth_mask=rng.random(steps) < 0.8,
        landmark_positions=places,
        landmark_names=np.arange(landmarks, dtype=np.int32) + 6,
        num_skipped=0,
    )


def wheels_of(poses):
    """What wheels report that begin elsewhere and drift."""
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
    times, wheels = 0.5 + np.arange(SCANS), wheels_of(poses)
    ranges = np.where(np.arange(91) % 30 == 7, np.inf, np.asarray(ranges))
    return LaserLog(times, wheels, ranges.astype(np.float32), LIDAR, 0, times, wheels), poses


@pytest.fixture(scope="module")
def scan_log(recording):
    """The recording as a log, with a reference of some of its scans, on a clock not quite its."""
    drive, poses = recording
    some = np.array([FIRST, FIRST + 1, FIRST + 3])
    extra = np.array([[9.0, 9.0, 9.0]])
    times = np.append(drive.times[some] + [0.01, -0.02, 0.0], drive.times[1] + 0.4)
    known = np.concatenate([poses[some], extra])
    return episodes.episode_from_laser_log(CONFIG, drive, (times, known)), some


CONFIG = Config.for_lidar(
    LIDAR,
    filter=FilterConfig(
        max_landmarks=12,
    ),
)


@pytest.mark.parametrize("seed", range(3))
def test_sightings_are_the_features_of_a_slow_version(seed):
    drive = sightings(seed)
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


def test_a_sighting_is_as_sure_as_a_part_of_its_range_and_sure_of_its_bearing():
    drive = sightings(0)
    log = episodes.episode_from_landmark_log(drive)
    polar_cov = jax.vmap(measurement_model.polar_cov)(
        jnp.asarray(log.features.xy[drive.valid]), jnp.asarray(log.features.cov[drive.valid])
    )
    expected = np.zeros(polar_cov.shape)
    expected[:, 0, 0] = (
        episodes.RANGE_STD_FRACTION * drive.range_bearing[drive.valid][:, 0].astype(float)
    ) ** 2
    np.testing.assert_allclose(polar_cov, expected, atol=1e-15)
    assert expected.max() > 1e-4


def test_logs_are_in_the_precision_of_jax():
    for log in (
        episodes.episode_from_landmark_log(sightings(0)),
        episodes.stack_episodes([episodes.episode_from_landmark_log(sightings(0))]),
    ):
        leaves = jax.tree.leaves(log)
        assert all(type(leaf) is np.ndarray for leaf in leaves)
        assert {leaf.dtype.name for leaf in leaves} == {"float64", "int32", "bool"}
    with jax.enable_x64(False):
        leaves = jax.tree.leaves(episodes.episode_from_landmark_log(sightings(0)))
    assert {leaf.dtype.name for leaf in leaves} == {"float32", "int32", "bool"}


def test_a_recording_begins_at_its_first_reference(recording, scan_log):
    (_, poses), (log, some) = recording, scan_log
    assert {len(leaf) for leaf in jax.tree.leaves(log)} == {
        SCANS - FIRST
    } and log.landmark_ids is None
    judged = np.isin(np.arange(FIRST, SCANS), some)
    np.testing.assert_array_equal(log.truth_mask, judged)
    np.testing.assert_array_equal(log.truth[judged], poses[some])
    assert not log.truth[~judged].any() and judged[0]


def test_motions_of_a_recording_lead_along_the_way_of_the_wheels(recording, scan_log):
    wheels, log = recording[0].odom_poses[FIRST:], scan_log[0]
    assert not log.odometry[0].any() and (np.abs(log.odometry[1:]).max(axis=1) > 0.1).all()
    pose, chained = wheels[0], [wheels[0]]
    for motion in log.odometry[1:]:
        pose = reference_filter.compose(pose, motion)
        chained.append(pose)
    off = np.array(chained) - wheels
    np.testing.assert_allclose(off[:, :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.sin(off[:, 2] / 2), 0.0, atol=1e-12)


def test_features_of_a_recording_are_those_of_each_scan(recording, scan_log):
    ranges, log = recording[0].ranges, scan_log[0]
    look = jax.jit(extract.extract_features, static_argnums=0)
    for t in range(SCANS - FIRST):
        expected = look(CONFIG, lidar.to_scan(LIDAR, jnp.asarray(ranges[FIRST + t], float)))
        for a, b in zip(log.features, expected, strict=True):
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
    """Info of a log of sightings, its three losses, and the gradient of their sum in the noise."""

    def run(theta):
        noise = jax.tree.map(jnp.exp, theta)
        start = init(SIGHTINGS.filter, log.truth[0])
        _, info = slam_filter.run_filter(
            SIGHTINGS.filter,
            noise,
            start,
            Measurement(log.odometry, log.features, log.landmark_ids),
        )
        return jnp.stack([loss(info, log) for loss in LOSSES]), info

    theta = jax.tree.map(jnp.log, NoiseParams.for_landmark_sensor())
    value, back, info = jax.vjp(run, theta, has_aux=True)
    return info, value, back(jnp.ones(len(LOSSES)))[0]


SIGHTINGS = Config(
    filter=FilterConfig(
        max_landmarks=4,
        max_updates=5,
        max_new=5,
        landmark_kinds=(JUNCTION,),
    ),
)


def take(logs, run):
    return jax.tree.map(lambda x: x[run], logs)


def check_same(short, long, steps):
    """Info of a log and of the same log with padding."""
    for name, a, b in zip(short._fields, short, long, strict=True):
        b = b[:steps]
        b = b[:, : a.shape[1]] if name in ("slot", "id", "used") else b
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.fixture(scope="module")
def pair():
    """Logs of sightings, one shorter and with fewer at a time; stacked."""
    few, many = sightings(1, steps=6, most=2), sightings(2, steps=9, most=5)
    few = few._replace(truth_mask=np.array([True, True, False, True, True, True]))
    logs_ = [episodes.episode_from_landmark_log(one) for one in (few, many)]
    return logs_, episodes.stack_episodes(logs_)


def test_padding_changes_nothing_of_a_drive(pair):
    (short, long), both = pair
    assert both.odometry.shape == (2, 9, 3) and both.landmark_ids.shape == (2, 9, 5)
    info, value, slope = filtered(short)
    padded, same_value, same_slope = filtered(take(both, 0))
    check_same(info, padded, 6)
    np.testing.assert_allclose(same_value, value, rtol=1e-9)
    for a, b in zip(*map(jax.tree.leaves, (slope, same_slope)), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-7, atol=1e-12)
    assert np.isfinite(value).all() and np.abs(slope.odometry_coefficients).min() > 0.0
    assert info.used.sum() >= 4 and not padded.used[6:].any() and not padded.dof[6:].any()
    np.testing.assert_array_equal(padded.last_pose[6:], np.tile(padded.last_pose[5], (3, 1)))
    np.testing.assert_array_equal(padded.pose_cov[6:], np.tile(padded.pose_cov[5], (3, 1, 1)))
    last = take(both, 1)._replace(num_steps=None)
    for a, b in zip(jax.tree.leaves(long), jax.tree.leaves(last), strict=True):
        np.testing.assert_array_equal(a, b)


def test_padding_changes_nothing_where_everything_is_judged(pair):
    (short, long), _ = pair
    both = episodes.stack_episodes([short._replace(truth_mask=None), long])
    np.testing.assert_array_equal(both.truth_mask[0], np.arange(9) < 6)
    value = filtered(short._replace(truth_mask=np.ones(6, bool)))[1]
    np.testing.assert_allclose(filtered(take(both, 0))[1], value, rtol=1e-9)


def test_padding_changes_nothing_of_scans(scan_log):
    """A filter knows nothing of what comes: alone, the log has the info of a longer one."""
    log, steps = scan_log[0], SCANS - FIRST
    longer = jax.tree.map(lambda x: np.concatenate([x, x[::-1]]), log)
    both = episodes.stack_episodes([log, longer])

    def run(one):
        start, inputs = init(CONFIG.filter, one.truth[0]), Measurement(one.odometry, one.features)
        return jax.tree.map(
            np.asarray,
            slam_filter.run_filter(CONFIG.filter, NoiseParams.for_laser_log(), start, inputs)[1],
        )

    judge = jax.jit(lambda info, log: [loss(info, log) for loss in LOSSES])
    info, padded = jax.tree.map(lambda x: x[:steps], run(longer)), run(take(both, 0))
    check_same(info, padded, steps)
    assert info.used.sum() > 4
    alone = np.array(judge(info, log))
    assert alone.all()
    np.testing.assert_allclose(judge(padded, take(both, 0)), alone, rtol=1e-9)


def test_landmarks_stay_while_a_stacked_drive_stands_blind(scan_log):
    """Which they would not, were it looking: thirty scans without what is in plain sight."""
    log = scan_log[0]
    still = np.zeros((30, 3), log.odometry.dtype)
    longer = Episode(
        np.concatenate([log.truth, still]), np.concatenate([log.odometry, still]), log.features
    )
    none = jax.tree.map(lambda x: np.zeros_like(np.repeat(x[:1], 30, axis=0)), log.features)
    blank = jax.tree.map(lambda *x: np.concatenate(x), log.features, none)
    both = episodes.stack_episodes([log, longer._replace(features=blank)])
    noise = NoiseParams.for_laser_log()
    alone = episodes.filter_episode(CONFIG, noise, log)
    found = episodes.filter_episode(CONFIG, noise, take(both, 0))
    assert int(alone.num_landmarks) > 2
    assert int(found.num_landmarks) == int(alone.num_landmarks) and int(found.num_steps) == len(
        log.truth
    )


def test_stacked_padding_is_blank(pair):
    both = pair[1]
    assert not both.truth_mask[0, 6:].any() and not both.odometry[0, 6:].any()
    assert both.num_steps.tolist() == [6, 9]
    valid = both.features.valid[0]
    assert not valid[6:].any() and not valid[:, 2:].any()
    assert (both.landmark_ids[0, 6:] == -1).all() and (both.landmark_ids[0, :, 2:] == -1).all()


def test_what_cannot_be_stacked(pair, scan_log):
    with pytest.raises(ValueError, match="no logs"):
        episodes.stack_episodes([])
    for mixed in ([pair[0][0], scan_log[0]], [scan_log[0], pair[0][0]]):
        with pytest.raises(ValueError, match="with and without `known`"):
            episodes.stack_episodes(mixed)


def test_a_filter_of_sightings_has_room_for_all():
    drives = [sightings(0, most=2, landmarks=7), sightings(1, most=5, landmarks=6)]
    config = episodes.landmark_log_config(drives)
    assert (config.filter.max_landmarks, config.filter.max_updates, config.filter.max_new) == (
        7,
        5,
        5,
    )
    assert config.filter.landmark_kinds == (JUNCTION,)
