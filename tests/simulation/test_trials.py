import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import se2
from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import relative, wrap_angle
from jaxslam.evaluation.summary import evaluate
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.grid import GridSpec
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import TrialResult
from jaxslam.simulation import path_following, robot, trials, worlds
from jaxslam.simulation.drives import drive, num_scans_of_drive
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World

STEPS = 6
CONFIG = Config.for_lidar(
    Lidar(num_beams=181, angle_increment=np.pi / 180),
    frontend=FrontendConfig(
        grid=GridSpec(x_max=5.0, y_half=4.0),
    ),
    filter=FilterConfig(
        max_landmarks=16,
        max_updates=4,
    ),
)
ROBOT = Robot()
KEY = jax.random.key(5)
PATH = path_following.densify(np.array([(0.7, 0.8), (2.0, 1.0), (2.2, 2.3), (1.6, 3.6)]))


SETTING = (
    CONFIG,
    NoiseParams.for_simulated_robot(*ROBOT),
    World(jnp.asarray(worlds.named("fig07").walls)),
    ROBOT,
    jnp.asarray(PATH),
)


def experiment(runs, devices, key=KEY, first=0):
    own = jax.devices()[:devices]
    return list(
        trials.run_trials(key, *SETTING, num_trials=runs, num_scans=STEPS, first=first, devices=own)
    )


@pytest.fixture(scope="module")
def nine():
    return experiment(9, devices=2)


def assert_same(one, two):
    jax.tree.map(np.testing.assert_array_equal, one, two)


def test_runs_depend_neither_on_their_number_nor_on_the_devices(nine):
    many, few = (
        episodes.concatenate_results(nine),
        episodes.concatenate_results(experiment(6, devices=1)),
    )
    assert_same(jax.tree.map(lambda x: x[:6], many), few)
    assert len(np.unique(many.truth[:, -1, 0])) == 9
    assert all(isinstance(x, np.ndarray) for x in many)


@pytest.mark.parametrize("first, runs, sizes", [(0, 9, [4, 4, 1]), (3, 6, [1, 2]), (6, 7, [1])])
def test_an_experiment_goes_on_where_another_ended(nine, first, runs, sizes):
    rest = experiment(runs, devices=1, first=first)
    assert [len(part.truth) for part in rest] == sizes
    whole = jax.tree.map(lambda x: x[first:runs], episodes.concatenate_results(nine))
    assert_same(episodes.concatenate_results(rest), whole)


def test_there_is_nothing_after_the_last_run():
    assert experiment(8, devices=2, first=8) == []


def test_experiment_yields_the_runs_in_order(nine):
    assert [len(part.truth) for part in nine] == [8, 1]
    keys = jax.vmap(lambda k: jax.random.split(k)[0])(
        jnp.stack([jax.random.fold_in(KEY, i) for i in range(9)])
    )
    truth, _ = driven(keys, STEPS)
    np.testing.assert_allclose(episodes.concatenate_results(nine).truth, truth, atol=1e-12)


def test_the_filter_finds_and_uses_landmarks(nine):
    tracks = episodes.concatenate_results(nine)
    assert tracks.finite.all() and np.all(tracks.num_landmarks > 2)
    assert np.all(tracks.num_updates[:, 2:] > 0)
    summary = evaluate(tracks)
    assert summary["runs"] == 9 and summary["scans"] == 9 * STEPS and summary["diverged"] == 0
    assert summary["position_rmse_m"] < 0.03


def driven(keys, steps):
    many = jax.vmap(lambda key: drive(key, ROBOT, jnp.asarray(PATH), num_scans=steps))
    return jax.tree.map(np.asarray, jax.jit(many)(keys))


@pytest.fixture(scope="module")
def steps():
    return num_scans_of_drive(ROBOT, PATH)


@pytest.fixture(scope="module")
def drives(steps):
    return driven(jax.random.split(jax.random.key(1), 300), steps)


def test_drives_stay_near_the_path_and_reach_its_end(drives):
    truth, _ = drives
    gap = np.linalg.norm(truth[:, :, None, :2] - PATH, axis=-1).min(axis=-1)
    assert gap.max() < 0.2
    assert np.linalg.norm(truth[:, -1, :2] - PATH[-1], axis=-1).max() < 0.35  # one stride


def test_drive_steps_is_the_noise_free_length(steps):
    still = ROBOT._replace(encoder_noise=0.0)
    truth, told = jax.jit(lambda key: drive(key, still, jnp.asarray(PATH), num_scans=steps + 2))(
        KEY
    )
    np.testing.assert_array_equal(np.any(told != 0, axis=1)[1:], np.arange(steps + 1) < steps - 1)
    np.testing.assert_allclose(se2.dead_reckoning(truth[0], told), truth, atol=1e-12)


def test_encoders_have_the_noise_they_promise(drives):
    """A wheel that rolls w errs by k sqrt(|w|), independent of the other; 5 standard errors."""
    truth, told = drives
    moves = jax.vmap(relative)(truth[:, :-1].reshape(-1, 3), truth[:, 1:].reshape(-1, 3))
    told = told[:, 1:].reshape(-1, 3)
    said = np.stack(jax.vmap(robot.wheel_distances, (0, None))(jnp.asarray(told), ROBOT.wheel_base))
    rolls = np.all(np.abs(said) > 0, axis=0)
    variance = ROBOT.encoder_noise**2 * np.abs(said).sum(axis=0)[rolls]
    turn = np.asarray(wrap_angle(moves[:, 2] - told[:, 2]))[rolls]
    rolled = np.stack(jax.vmap(robot.wheel_distances, (0, None))(moves, ROBOT.wheel_base))
    forward = np.mean(rolled - said, axis=0)[rolls]
    count = rolls.sum()
    assert count > 5000
    for error, spread in [(turn, variance / ROBOT.wheel_base**2), (forward, variance / 4)]:
        z = error / np.sqrt(spread)
        assert abs(np.mean(z)) < 5 / np.sqrt(count)
        assert abs(np.mean(z**2) - 1) < 5 * np.sqrt(2 / count)


def track(final, *, finite=True, nan=False):
    """A run of two scans whose last estimate is `final` [m] off, dead reckoning twice that."""
    estimate = np.zeros((2, 3))
    estimate[1, 0] = np.nan if nan else final
    odometry = np.zeros((2, 3))
    odometry[1, 0] = 2 * final
    return TrialResult(
        truth=np.zeros((2, 3)),
        estimate=estimate,
        cov=np.stack([np.zeros((3, 3)), np.diag([0.04, 0.04, 0.01])]),
        dead_reckoning=odometry,
        num_updates=np.array([0, 3], np.int32),
        num_landmarks=np.int32(4),
        finite=np.bool_(finite),
        truth_mask=np.ones(2, bool),
        num_steps=np.int32(2),
    )


def test_evaluate_counts_diverged_and_nonfinite_runs_and_masks_the_latter():
    runs = [track(0.2), track(1.5), track(0.0, nan=True), track(0.0, finite=False), track(-0.4)]
    summary = evaluate(jax.tree.map(lambda *x: np.stack(x), *runs))
    good = np.array([0.2, 1.5, -0.4])
    assert summary["runs"] == 5 and summary["diverged_runs"] == [1, 2, 3]
    assert summary["nonfinite_runs"] == [2, 3] and summary["nonfinite"] == 2
    assert summary["diverged"] == 3 and summary["dead_reckoning"]["diverged"] == 1
    assert summary["position_rmse_m"] == pytest.approx(np.sqrt(np.mean(good**2) / 2))
    assert summary["heading_rmse_deg"] == 0
    # The certain first pose has no NEES.
    assert summary["nees"] == pytest.approx(np.mean(good**2 / 0.04) / 3)
    assert summary["landmarks"] == 4 and summary["matches"] == 1.5
    assert summary["dead_reckoning"]["position_rmse_m"] == pytest.approx(
        2 * summary["position_rmse_m"]
    )


def test_steps_that_never_were_and_runs_without_truth_count_nowhere():
    """A drive of two scans beside one of five, as `episodes.stack_episodes` pads it, and one without truth."""
    fill = lambda x: np.pad(x, [(0, 3 if x.ndim and len(x) == 2 else 0)] + [(0, 0)] * (x.ndim - 1))
    short = track(0.2)
    padded = jax.tree.map(lambda x: fill(np.asarray(x)) if np.ndim(x) else x, short)
    padded.estimate[2:] = padded.estimate[1]
    long = padded._replace(
        truth_mask=np.ones(5, bool), num_steps=np.int32(5), estimate=np.zeros((5, 3))
    )
    blind = padded._replace(truth_mask=np.zeros(5, bool), estimate=np.full((5, 3), 7.0))
    stack = lambda *runs: evaluate(jax.tree.map(lambda *x: np.stack(x), *runs))
    alone, both = stack(short), stack(padded, blind)
    for key in ("position_rmse_m", "heading_rmse_deg", "nees", "diverged", "matches"):
        assert both[key] == alone[key], key
    assert both["scans"] == 4 and both["dead_reckoning"] == alone["dead_reckoning"]
    assert stack(padded, long)["scans"] == 7 and stack(padded, long)["matches"] == 6 / 7
    nothing = stack(blind)
    assert nothing["position_rmse_m"] is None and nothing["nees"] is None
    assert nothing["diverged"] == 0
