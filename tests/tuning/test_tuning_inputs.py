"""What the functions of `jaxslam.tuning` refuse, before anything is compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.measurement import ScanMatch
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import episode_from_arrays
from jaxslam.pipeline.stacking import stack_episodes
from jaxslam.tuning import fitting, losses, optimizers, standard_errors
from jaxslam.tuning.inputs import as_episodes

B, T, M, L = 3, 4, 2, 5
CONFIG = Config.for_landmark_sensor(L, M)
PARAMS = NoiseParams.for_landmark_sensor()


def make_episodes(m=M):
    """B episodes of T steps with m measurements of known landmarks each."""
    rng = np.random.default_rng(0)
    odometry = np.tile([0.1, 0.0, 0.05], (T, 1)) * (np.arange(T) > 0)[:, None]
    return stack_episodes(
        [
            episode_from_arrays(
                odometry,
                rng.uniform([1.0, -1.0], [3.0, 1.0], (T, m, 2)),
                np.tile(np.arange(m), (T, 1)),
                np.cumsum(odometry, axis=0),
            )
            for _ in range(B)
        ]
    )


EPISODES = make_episodes()
MATCHES = ScanMatch(np.zeros((B, T, 3)), np.zeros((B, T, 3, 3)), np.zeros((B, T)))
MATCHED = PARAMS._replace(scan_match_std_scale=0.3)


@pytest.fixture
def no_work(monkeypatch):
    """Fail the test if an evaluation of the filter is started."""
    monkeypatch.setattr(fitting, "_evaluate", lambda *_: pytest.fail("work has begun"))


def with_features(**changes):
    return EPISODES._replace(features=EPISODES.features._replace(**changes))


BAD_ARGUMENTS = [
    (
        (PARAMS, CONFIG, EPISODES),
        "model is NoiseParams, not Config or a tuning.Model; the order is model, params",
    ),
    ((CONFIG.filter, PARAMS, EPISODES), "model is FilterConfig, not Config"),
    ((CONFIG, EPISODES, PARAMS), "params is Episode, not NoiseParams"),
    ((CONFIG, dict(PARAMS._asdict()), EPISODES), "params is dict, not NoiseParams"),
    ((CONFIG, PARAMS, [EPISODES]), r"episodes.odometry is float64 \(1, 3, 4, 3\), not floating"),
    (
        (CONFIG, PARAMS._replace(odometry_coefficients=[0.1] * 3), EPISODES),
        r"params.odometry_coefficients is .*\(3,\), not floating \(4,\)",
    ),
    ((CONFIG, PARAMS._replace(range_std="1"), EPISODES), "params.range_std is .*, not numbers"),
    ((CONFIG, PARAMS._replace(range_std=None), EPISODES), "params.range_std is object"),
    ((CONFIG, MATCHED, EPISODES), "params.scan_match_std_scale is given, but episodes.scan_match"),
    (
        (CONFIG, PARAMS, EPISODES._replace(scan_matches=MATCHES)),
        "params.scan_match_std_scale is None, but episodes.scan_matches are given",
    ),
    (
        (CONFIG, MATCHED, EPISODES._replace(scan_matches=MATCHES._replace(increment=np.eye(3)))),
        r"episodes.scan_matches.increment is .*\(3, 3\), not floating \(3, 4, 3\)",
    ),
    (
        (CONFIG, PARAMS, jax.tree.map(lambda x: x[0], EPISODES)),
        r"episodes.odometry is .* \(4, 3\), not floating \(B, T, 3\)",
    ),
    ((CONFIG, PARAMS, EPISODES._replace(truth=EPISODES.truth[:, 1:])), "episodes.truth is .*3, 3"),
    ((CONFIG, PARAMS, EPISODES._replace(odometry="none")), "episodes.odometry is <U4"),
    ((CONFIG, PARAMS, EPISODES._replace(odometry=[[0.0], [1.0, 2.0]])), "parts differ in shape"),
    ((CONFIG, PARAMS, with_features(xy=np.zeros((B, T, M)))), "episodes.features.xy is"),
    ((CONFIG, PARAMS, with_features(kind=np.zeros((B, T, M)))), "episodes.features.kind is float"),
    ((CONFIG, PARAMS, with_features(valid=np.ones((B, T, M)))), "episodes.features.valid is float"),
    ((CONFIG, PARAMS, EPISODES._replace(features=EPISODES)), "episodes.features is Episode"),
    (
        (CONFIG, PARAMS, EPISODES._replace(landmark_ids=EPISODES.landmark_ids + L)),
        "episodes.landmark_ids holds 6, but config.filter.max_landmarks is 5",
    ),
    ((CONFIG, PARAMS, EPISODES, 3.0), "loss is 3.0, not a function"),
    ((CONFIG, PARAMS, EPISODES, "likelihood"), "loss is 'likelihood'; known names are pose_nll"),
    ((CONFIG, PARAMS, EPISODES, losses.WeightedLoss(())), "loss is a WeightedLoss without terms"),
    ((CONFIG, PARAMS, jax.tree.map(lambda x: x[:0], EPISODES)), "episodes: no episodes"),
    (
        (CONFIG, PARAMS, EPISODES._replace(truth_mask=np.zeros((B, T), bool))),
        "episodes: episode 0 has no reference, which this loss needs",
    ),
]


@pytest.mark.parametrize("arguments, message", BAD_ARGUMENTS)
def test_bad_arguments_are_refused_by_name(no_work, arguments, message):
    config, params, episodes, loss = (*arguments, losses.pose_nll)[:4]
    for function in (fitting.tune, standard_errors.standard_errors):
        with pytest.raises(ValueError, match=message):
            function(config, params, episodes, loss=loss)
    for function in (fitting.values, fitting.gradients):
        with pytest.raises(ValueError, match=message):
            function(config, params, episodes, loss)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"wall_angle_std": 0.0}, "params.wall_angle_std is 0.0, not positive and finite"),
        ({"range_std": np.nan}, "params.range_std is nan, not positive"),
        ({"bearing_std": -1}, "params.bearing_std is -1.0, not positive"),
        ({"odometry_coefficients": [1, 1, 0, 1]}, r"params.odometry_coefficients is \[1.0, 1.0, 0"),
        ({"feature_std_scale": np.inf}, "params.feature_std_scale is inf"),
    ],
)
def test_noise_that_is_not_positive_is_refused(no_work, changes, message):
    for function in (fitting.tune, standard_errors.standard_errors):
        with pytest.raises(ValueError, match=message):
            function(CONFIG, PARAMS._replace(**changes), EPISODES)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"frozen": ("range",)}, "no parameter is called 'range'; known: odometry_coefficients"),
        ({"frozen": "range_std"}, "frozen is the string 'range_std'"),
        ({"frozen": PARAMS._fields}, "all parameters are frozen"),
        ({"num_updates": -1}, "num_updates is -1, not a whole number of at least 0"),
        ({"num_updates": 1.5}, "num_updates is 1.5, not a whole number"),
        ({"batch_size": 0}, "batch_size is 0, not a whole number of at least 1"),
        ({"seed": -1}, "seed is -1, not a whole number of at least 0"),
        ({"patience": 0}, "patience is 0"),
        ({"evaluate_every": 0}, "evaluate_every is 0"),
        ({"state": 3}, "state is int, not TuneState"),
        ({"heldout": make_episodes(M + 1)}, "heldout has M = 3 features a step, episodes has 2"),
        ({"heldout": EPISODES._replace(landmark_ids=None)}, "heldout.landmark_ids is None, but ep"),
        ({"heldout": EPISODES._replace(scan_matches=MATCHES)}, "but heldout.scan_matches are give"),
        ({"heldout": EPISODES.features}, "heldout is Features, not Episode"),
        (
            {"heldout": EPISODES._replace(truth_mask=np.zeros((B, T), bool))},
            "heldout: episode 0 has no reference",
        ),
    ],
)
def test_bad_settings_of_a_tuning_are_refused(no_work, changes, message):
    with pytest.raises(ValueError, match=message):
        fitting.tune(CONFIG, PARAMS, EPISODES, **changes)


def test_a_state_of_another_tuning_is_refused(no_work):
    optimizer = optimizers.default_optimizer(3, whole=True)
    state = fitting.init(PARAMS, num_updates=3, optimizer=optimizer)
    with pytest.raises(ValueError, match="state is of 3 updates of 8 parameters, not of 4 of 8"):
        fitting.tune(CONFIG, PARAMS, EPISODES, num_updates=4, state=state)


def test_standard_errors_refuse_unknown_names_and_a_single_episode(no_work):
    with pytest.raises(ValueError, match="no parameter is called 'range'"):
        standard_errors.standard_errors(CONFIG, PARAMS, EPISODES, frozen=("range",))
    one = jax.tree.map(lambda x: x[:1], EPISODES)
    with pytest.raises(ValueError, match="two episodes or more; episodes has 1"):
        standard_errors.standard_errors(CONFIG, PARAMS, one)


def test_the_default_optimiser_and_the_names_refuse_what_they_do_not_know():
    for bad, message in (
        (-1, "num_updates is -1"),
        ("30", "num_updates is '30', not a whole number"),
    ):
        with pytest.raises(ValueError, match=message):
            optimizers.default_optimizer(bad, whole=False)
    with pytest.raises(ValueError, match="whole is None, not True or False"):
        optimizers.default_optimizer(3, whole=None)


def test_the_default_optimiser_is_one_object_for_the_same_arguments():
    """It is static under jit: another object would be compiled again."""
    for whole in (True, False):
        first, second = (optimizers.default_optimizer(n, whole=whole) for n in (5, np.int32(5)))
        assert first is second


def convert(record, function):
    """A record with each of its arrays converted; None stays."""
    if record is None:
        return None
    if not hasattr(record, "_fields"):
        return function(record)
    return type(record)(*(convert(x, function) for x in record))


def to_float32(x):
    x = np.asarray(x)
    return x.astype(np.float32) if x.dtype.kind == "f" else x


def test_lists_numpy_and_jax_arrays_give_the_same_result():
    """Of numbers that float32 holds exactly, so that its precision makes no difference."""
    episodes = convert(EPISODES, lambda x: np.asarray(to_float32(x), x.dtype))
    params = convert(PARAMS, lambda x: np.asarray(to_float32(x), np.float64))
    kinds = (np.asarray, jnp.asarray, lambda x: np.asarray(x).tolist(), to_float32)
    results = [fitting.gradients(CONFIG, convert(params, f), convert(episodes, f)) for f in kinds]
    for value, slope in results[1:]:
        np.testing.assert_array_equal(value, results[0][0])
        np.testing.assert_array_equal(slope, results[0][1])
    assert np.isfinite(results[0][1]).all()


@pytest.mark.usefixtures("single_precision")
def test_whole_numbers_are_taken_as_noise():
    whole = NoiseParams([1, 1, 1, 1], 1, 1, 1, 1)
    floats = convert(whole, lambda x: np.asarray(x, np.float64))
    assert as_episodes(EPISODES).truth.dtype == np.float32
    results = [fitting.values(CONFIG, params, EPISODES) for params in (whole, floats)]
    np.testing.assert_array_equal(*results)
    assert np.isfinite(results[0]).all()


def test_episodes_that_need_no_change_are_not_copied():
    assert as_episodes(EPISODES).odometry is EPISODES.odometry


def test_a_list_of_single_episodes_and_the_name_of_a_loss_are_taken():
    singles = [jax.tree.map(lambda x: np.asarray(x)[k], EPISODES) for k in range(B)]  # noqa: B023
    problem = fitting.prepare(CONFIG, PARAMS, singles, "innovation_nll")
    assert problem.loss is losses.innovation_nll
    jax.tree.map(np.testing.assert_array_equal, problem.data, as_episodes(EPISODES))
