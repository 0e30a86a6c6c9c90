import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import increments, relative
from jaxslam.filtering.config import FilterConfig
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.grid import GridSpec
from jaxslam.matching import scan_matching
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import kinematics, named, path_following, trials
from jaxslam.simulation.drives import simulate_scans
from jaxslam.simulation.life import life_in
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.trial_episodes import simulate_episodes, trial_keys
from jaxslam.simulation.wheel_faults import WheelFaults, can_fail

CONFIG = Config.for_lidar(
    Lidar(num_beams=181, angle_increment=np.pi / 180),
    frontend=FrontendConfig(grid=GridSpec(x_max=5.0, y_half=4.0)),
    filter=FilterConfig(max_landmarks=16, max_updates=4),
)
KEY, ROBOT, WORLD, SCANS, TRIALS = jax.random.key(3), Robot(), named("fig07"), 7, 4
PATH = jnp.asarray(path_following.densify(np.array([(0.7, 0.8), (2.0, 1.0), (2.2, 2.3)])))
SLIPPING = life_in(WORLD, PATH, wheels=WheelFaults(slip=0.3, slip_share=0.5))
PARAMS = kinematics.noise_params(ROBOT, match_scans=True)
GIVEN = {"robot": ROBOT, "world": WORLD, "path": PATH, "num_scans": SCANS, "life": SLIPPING}


@pytest.fixture(scope="module")
def drives():
    return simulate_episodes(KEY, CONFIG, **GIVEN, num_trials=TRIALS, match_scans=True)


@pytest.fixture(scope="module")
def results():
    parts = trials.run_trials(KEY, CONFIG, PARAMS, **GIVEN, num_trials=TRIALS, match_scans=True)
    return episodes.concatenate_results(parts)


def turns_off(found, truth):
    """Largest error [rad] of the turns of increments (B, T, 3) along poses (B, T, 3)."""
    gap = (
        np.asarray(found)[..., 2] - np.stack([increments(np.asarray(one)) for one in truth])[..., 2]
    )
    return np.abs((gap + np.pi) % (2 * np.pi) - np.pi).max()


@pytest.mark.slow
def test_scans_show_the_turns_that_the_wheels_miss(drives):
    assert turns_off(drives.odometry, drives.truth) > 0.2
    assert turns_off(drives.scan_matches.increment, drives.truth) < 0.03


@pytest.mark.slow
def test_matches_of_a_trial_are_those_of_its_scans(drives):
    own = trial_keys(KEY, jnp.arange(TRIALS))[1]
    lidar, spec = CONFIG.frontend.lidar, CONFIG.scan_matching
    truth, odometry, scans = simulate_scans(
        own, lidar, ROBOT, WORLD, PATH, num_scans=SCANS, life=SLIPPING
    )
    submap = scan_matching.empty_submap(spec, lidar)
    found = scan_matching.match_scans(spec, lidar, submap, scans, odometry)[1]
    np.testing.assert_allclose(truth, drives.truth[1], atol=1e-9)
    np.testing.assert_allclose(found.increment, drives.scan_matches.increment[1], atol=1e-6)


@pytest.mark.slow
def test_trials_with_wheels_that_slip_keep_their_heading_by_scan_matching(drives, results):
    np.testing.assert_allclose(results.truth, drives.truth, atol=1e-9)
    off = np.stack([relative(*x) for x in zip(results.truth, results.estimate, strict=True)])
    assert np.abs(off[..., 2]).max() < 0.03 and np.abs(off[..., :2]).max() < 0.08


@pytest.mark.slow
def test_a_trial_that_is_replayed_is_that_of_the_experiment(results):
    truth, result = trials.replay_trial(KEY, CONFIG, PARAMS, **GIVEN, trial=2, match_scans=True)
    np.testing.assert_allclose(truth, results.truth[2], atol=1e-9)
    np.testing.assert_allclose(result.poses, results.estimate[2], atol=1e-5)


def test_scans_are_matched_only_with_noise_for_it():
    params = kinematics.noise_params(ROBOT)
    assert params.scan_match_std_scale is None
    given = KEY, CONFIG, params
    for call in (trials.run_trials, trials.replay_trial):
        number = {"trial": 0} if call is trials.replay_trial else {"num_trials": 1}
        with pytest.raises(ValueError, match="scan_match_std_scale is None, but scans are matched"):
            call(*given, **GIVEN, **number, match_scans=True)
    with pytest.raises(ValueError, match="match_scans is str, not bool"):
        simulate_episodes(KEY, CONFIG, **GIVEN, num_trials=1, match_scans="scan")


@pytest.mark.parametrize("name", WheelFaults._fields)
def test_only_faults_of_the_odometry_make_it_fail(name):
    faults = WheelFaults(**{name: 1.0})
    assert can_fail(faults) == (name in ("slip", "carpet", "lost", "carried"))
    assert not can_fail(WheelFaults())
