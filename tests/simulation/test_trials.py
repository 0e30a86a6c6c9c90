import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import se2
from jaxslam.core.se2 import relative, wrap_angle
from jaxslam.evaluation.summary import evaluate
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.mapping.config import MappingSpec
from jaxslam.pipeline import episodes
from jaxslam.simulation import path_following, robot, trial_episodes, trials, worlds
from jaxslam.simulation.drives import drive, num_scans_of_drive
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.trial_episodes import simulate_episodes
from jaxslam.simulation.trial_map import slam_result
from jaxslam.simulation.worlds import World
from tests.short_trials import CONFIG, PATH, ROBOT, STEPS

KEY = jax.random.key(5)
SETTING = (
    CONFIG,
    NoiseParams.for_simulated_robot(*ROBOT[:2]),
    ROBOT,
    World(jnp.asarray(worlds.named("fig07").walls)),
    jnp.asarray(PATH),
)


def experiment(num_trials, num_devices, key=KEY, first=0):
    sizes = {"num_trials": num_trials, "num_scans": STEPS, "first": first}
    return list(trials.run_trials(key, *SETTING, **sizes, devices=jax.devices()[:num_devices]))


@pytest.fixture(scope="module")
def nine():
    return experiment(9, num_devices=2)


def assert_same(one, two):
    jax.tree.map(np.testing.assert_array_equal, one, two)


def test_trials_depend_neither_on_their_number_nor_on_the_devices(nine):
    many, few = (
        episodes.concatenate_results(nine),
        episodes.concatenate_results(experiment(6, num_devices=1)),
    )
    assert_same(jax.tree.map(lambda x: x[:6], many), few)
    assert len(np.unique(many.truth[:, -1, 0])) == 9
    assert all(isinstance(x, np.ndarray) for x in many)


@pytest.mark.parametrize("first, total, sizes", [(0, 9, [4, 4, 1]), (3, 6, [1, 2]), (6, 7, [1])])
def test_an_experiment_resumes_where_another_ended(nine, first, total, sizes):
    rest = experiment(total, num_devices=1, first=first)
    assert [len(part.truth) for part in rest] == sizes
    whole = jax.tree.map(lambda x: x[first:total], episodes.concatenate_results(nine))
    assert_same(episodes.concatenate_results(rest), whole)


def test_there_is_nothing_after_the_last_trial():
    assert experiment(8, num_devices=2, first=8) == []


def test_experiment_yields_the_trials_in_order(nine):
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


@pytest.fixture(scope="module")
def mapped():
    """Nine trials, each part of them with what the map of its first one is made of."""
    return list(trials.run_trials_and_map(KEY, *SETTING, num_trials=9, num_scans=STEPS))


@pytest.mark.slow
def test_what_a_map_is_made_of_is_that_of_the_first_trial_of_each_part(nine, mapped):
    whole = episodes.concatenate_results(nine)
    assert_same(episodes.concatenate_results(results for results, _ in mapped), whole)
    first = 0
    for results, drive_ in mapped:
        assert_same(drive_.info.pose, whole.estimate[first])
        assert_same(drive_.info.pose_cov, whole.cov[first])
        assert drive_.belief.num_seen.shape == (16,) and drive_.scans.hit.shape == (STEPS, 181)
        first += len(results.truth)


@pytest.mark.slow
def test_the_map_of_a_trial_has_landmarks_of_its_filter_and_the_rooms_walls(mapped):
    _, drive_ = mapped[0]
    result = slam_result(CONFIG, drive_)
    np.testing.assert_allclose(result.poses, drive_.info.pose, atol=1e-12)
    graph, belief = result.topological_map, drive_.belief
    known = np.isin(graph.id, belief.id[belief.num_seen > 0])
    assert known.any() and result.next_id >= belief.next_id
    assert len(np.unique(graph.id)) == len(graph.id) and len(graph.arc_lines) > 0
    row, column = np.nonzero(result.occupancy.occupied)
    points = result.occupancy.origin[:2] + 0.05 * (np.column_stack([row, column]) + 0.5)
    start, end = np.split(np.asarray(SETTING[3].walls).reshape(-1, 4), 2, axis=1)
    along = end - start
    share = np.sum((points[:, None] - start) * along, axis=2) / np.sum(along**2, axis=1)
    nearest = start + np.clip(share, 0.0, 1.0)[..., None] * along
    assert np.hypot(*(points[:, None] - nearest).T).min(axis=0).max() < 0.1


@pytest.mark.slow
def test_a_map_of_the_arcs_of_single_scans_needs_a_replay(mapped):
    merged = CONFIG._replace(mapping=MappingSpec("merged"))
    with pytest.raises(ValueError, match="config.mapping.topology is 'merged', not 'grid'; replay"):
        slam_result(merged, mapped[0][1])


@pytest.mark.slow
def test_the_map_of_a_trial_is_the_one_that_a_replay_makes(mapped):
    truth, replayed = trials.replay_trial(KEY, *SETTING, trial=0, num_scans=STEPS)
    results, drive_ = mapped[0]
    found = slam_result(CONFIG, drive_)
    np.testing.assert_allclose(truth, results.truth[0], atol=1e-12)
    np.testing.assert_allclose(found.poses, replayed.poses, atol=1e-9)
    assert found.next_id == replayed.next_id
    assert_same(found.occupancy, replayed.occupancy)
    for one, two in zip(found.topological_map, replayed.topological_map, strict=True):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-6), one, two)
    for name in ("landmark_positions", "num_seen", "id", "kind"):
        one, two = (np.asarray(getattr(x.belief, name)) for x in (found, replayed))
        np.testing.assert_allclose(one, two, atol=1e-9)


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


def test_number_of_scans_is_that_of_the_noise_free_drive(steps):
    still = ROBOT._replace(encoder_noise=0.0)

    @jax.jit
    def longer(key):
        return drive(key, still, jnp.asarray(PATH), num_scans=steps + 2)

    truth, odometry = longer(KEY)
    moves = np.any(odometry != 0, axis=1)[1:]
    np.testing.assert_array_equal(moves, np.arange(steps + 1) < steps - 1)
    np.testing.assert_allclose(se2.dead_reckoning(truth[0], odometry), truth, atol=1e-12)


def test_encoders_have_the_noise_they_promise(drives):
    """A wheel that rolls w errs by k sqrt(|w|), independent of the other; 5 standard errors."""
    truth, odometry = drives
    moves = jax.vmap(relative)(truth[:, :-1].reshape(-1, 3), truth[:, 1:].reshape(-1, 3))
    odometry = odometry[:, 1:].reshape(-1, 3)
    distances = jax.vmap(lambda motion: robot.wheel_distances(motion, ROBOT.wheel_base))
    encoders = np.stack(distances(jnp.asarray(odometry)))
    rolls = np.all(np.abs(encoders) > 0, axis=0)
    variance = ROBOT.encoder_noise**2 * np.abs(encoders).sum(axis=0)[rolls]
    turn = np.asarray(wrap_angle(moves[:, 2] - odometry[:, 2]))[rolls]
    forward = np.mean(np.stack(distances(moves)) - encoders, axis=0)[rolls]
    count = rolls.sum()
    assert count > 5000
    for error, spread in [(turn, variance / ROBOT.wheel_base**2), (forward, variance / 4)]:
        z = error / np.sqrt(spread)
        assert abs(np.mean(z)) < 5 / np.sqrt(count)
        assert abs(np.mean(z**2) - 1) < 5 * np.sqrt(2 / count)


@pytest.fixture
def simulated(monkeypatch):
    """Calls of the simulation, which is left out."""
    calls = []

    def simulate(
        keys, config, robot, world, path, *, num_scans, noise_by_incidence, life, matching
    ):
        assert noise_by_incidence == 0.0 and life is matching is None
        calls.append((keys.shape, robot, world.walls, path, num_scans))

    monkeypatch.setattr(trial_episodes, "simulate_drives", simulate)
    monkeypatch.setattr(trials, "_SPREAD_GROUPS", None)
    return calls


def test_the_drive_is_by_default_that_of_the_office(simulated, monkeypatch):
    monkeypatch.setattr(trial_episodes, "num_scans_of_drive", lambda robot, path, world: len(path))
    simulate_episodes(KEY, CONFIG, num_trials=3)
    simulate_episodes(KEY, CONFIG, ROBOT, worlds.named("office"), OFFICE, num_trials=3)
    (shape, robot_, walls, path, num_scans), explicit = simulated
    assert shape == (3,) and robot_ == Robot() and num_scans == len(path) == len(OFFICE)
    np.testing.assert_array_equal(walls, worlds.named("office").walls)
    np.testing.assert_array_equal(path, OFFICE)
    assert explicit[4] == num_scans and walls.dtype == path.dtype == jnp.float64


OFFICE = path_following.densify(worlds.waypoints("office"))


@pytest.mark.parametrize("convert", [np.asarray, np.float32, jnp.asarray, np.ndarray.tolist])
def test_walls_and_paths_are_lists_or_arrays_of_either_precision(simulated, convert):
    walls, path = (np.float32(x).astype(float) for x in (worlds.named("fig07").walls, PATH))
    given = CONFIG, Robot(np.float32(0.5), 0), World(convert(walls)), convert(path)
    simulate_episodes(KEY, *given, num_trials=np.int32(2), num_scans=np.int64(4))
    ((shape, robot_, own_walls, own_path, num_scans),) = simulated
    assert (shape, robot_, num_scans) == ((2,), Robot(0.5, 0.0), 4)
    np.testing.assert_array_equal(own_walls, walls)
    np.testing.assert_array_equal(own_path, path)


WIDE = CONFIG._replace(filter=FilterConfig(field_of_view=(-3.0, 3.0)))
DRIVE = {"robot": ROBOT, "world": "fig07", "path": PATH, "num_scans": 4, "num_trials": 2}


@pytest.mark.parametrize(
    "changes, line",
    [
        ({"key": 0}, r"key is 0, not one key as jax.random.key\(seed\) makes it"),
        ({"key": jax.random.PRNGKey(0)}, r"key is uint32 \(2,\), not one key"),
        ({"key": jax.random.split(KEY)}, r"key is .* \(2,\), not one key"),
        ({"config": CONFIG.filter}, "config is FilterConfig, not Config"),
        ({"config": WIDE}, "make the configuration with Config.for_lidar"),
        ({"robot": 0.4}, "robot is float, not Robot"),
        ({"robot": Robot(0.0)}, "robot.wheel_base is 0.0, not above 0"),
        ({"robot": Robot(0.4, -1.0)}, "robot.encoder_noise is -1.0, not 0 or more"),
        ({"world": "moon"}, "no world named 'moon'; there are: fig04, .*, office"),
        ({"world": np.zeros((4, 4))}, "world is ndarray, not World or one of the names fig04, "),
        ({"world": World(np.zeros((4, 2)))}, r"world.walls is float64 \(4, 2\), not .*\(S, 4\)"),
        (
            {"world": World(np.full((4, 4), np.nan))},
            "world.walls holds .* not finite",
        ),
        ({"path": None}, "no drive named 'fig07'; there are: office"),
        ({"path": None, "world": worlds.named("fig07")}, "path is None; a world without a name"),
        ({"path": PATH[:5]}, r"path is \(5, 2\), not \(N >= 6, 2\)"),
        ({"path": PATH[:, :1]}, r"path is float64 \(\d+, 1\), not floating \(N, 2\)"),
        ({"path": np.full((6, 2), np.inf)}, "path holds numbers that are not finite"),
        ({"path": 2.0 * np.arange(14.0).reshape(7, 2)}, "path has points 5.66 m apart; .*densify"),
        ({"path": np.linspace(PATH[0], PATH[-1], 999)}, "40 of them must span 0.5 m: .*densify"),
        ({"path": PATH + [3.0, 0.0]}, "path goes through a wall at x 5.00, y 2.73 m; keep"),
        ({"num_scans": 0}, "num_scans is 0, not a whole number of at least 1"),
        ({"num_scans": 2.5}, "num_scans is 2.5, not a whole number"),
        ({"num_trials": 0}, "num_trials is 0, not a whole number of at least 1"),
    ],
)
def test_a_simulation_that_is_not_possible_is_refused(simulated, changes, line):
    given = {"key": KEY, "config": CONFIG} | DRIVE | changes
    with pytest.raises(ValueError, match=line):
        simulate_episodes(**given)
    with pytest.raises(ValueError, match=line):  # at the call, not at the first result
        trials.run_trials(params=SETTING[1], **given)
    one = {name: x for name, x in given.items() if name != "num_trials"}
    if "num_trials" not in changes:
        with pytest.raises(ValueError, match=line):
            trials.replay_trial(params=SETTING[1], **one, trial=0)
    assert not simulated


@pytest.mark.parametrize(
    "changes, line",
    [
        ({"first": -1}, "first is -1, not a whole number of at least 0"),
        ({"devices": []}, "devices is empty"),
        ({"params": None}, "params is NoneType, not NoiseParams"),
        ({"params": SETTING[1]._replace(range_std=0.0)}, "params.range_std is 0.0"),
    ],
)
def test_trials_that_are_not_possible_are_refused(simulated, changes, line):
    with pytest.raises(ValueError, match=line):
        trials.run_trials(**{"key": KEY, "config": CONFIG, "params": SETTING[1]} | DRIVE | changes)


def test_a_path_that_is_too_short_is_refused_by_all_that_drive_along_it():
    with pytest.raises(ValueError, match=r"path is \(5, 2\), not \(N >= 6, 2\)"):
        num_scans_of_drive(ROBOT, PATH[:5])
    with pytest.raises(ValueError, match=r"path is \(5, 2\), not \(N >= 6, 2\)"):
        drive(KEY, ROBOT, jnp.asarray(PATH[:5]), num_scans=3)


@pytest.mark.slow
def test_a_trial_is_replayed_with_its_own_noise(nine):
    truth, result = trials.replay_trial(KEY, *SETTING, trial=5, num_scans=STEPS)
    whole = episodes.concatenate_results(nine)
    np.testing.assert_allclose(truth, whole.truth[5], atol=1e-12)
    np.testing.assert_allclose(result.poses, whole.estimate[5], atol=1e-9)
