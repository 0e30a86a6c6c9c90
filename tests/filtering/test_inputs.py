"""What the filter refuses, by name and before anything is compiled; and what it takes alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement, ScanMatch
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering import slam_filter
from jaxslam.filtering.belief import add_known_landmarks, grow_belief
from jaxslam.filtering.config import FilterConfig, check_config, init
from jaxslam.filtering.covariance import defer
from jaxslam.filtering.data_association import AssociationSpec
from jaxslam.filtering.inputs import check_params
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config

T, M, L = 4, 3, 6
CONFIG = FilterConfig(max_landmarks=L, max_updates=2, max_new=2)
NOISE = NoiseParams.for_laser_log()
MATCHED = NoiseParams.for_laser_log(match_scans=True)


def measurements(*lead):
    """NumPy measurements in float64 that lead with T, or of one step."""
    shape = (*lead, M)
    xy = np.array([[3.0, 0.5], [2.0, -1.0], [0.0, 0.0]])
    features = Features(
        kind=np.broadcast_to(np.array([JUNCTION, CORNER, WALL]), shape),
        xy=np.broadcast_to(xy, (*shape, 2)),
        cov=np.broadcast_to(1e-3 * np.eye(2), (*shape, 2, 2)),
        direction=np.broadcast_to([0.0, 1.0, 0.3], shape),
        direction_variance=np.full(shape, 1e-4),
        descriptor=np.full(shape, 1.0),
        degree=np.full(shape, 3),
        certified=np.ones(shape, bool),
        trusted=np.ones(shape, bool),
        valid=np.ones(shape, bool),
    )
    return Measurement(np.zeros((*lead, 3)), features)


def scan_matches(*lead):
    eye = np.broadcast_to(np.eye(3), (*lead, 3, 3))
    return ScanMatch(np.zeros((*lead, 3)), eye, np.ones(lead))


def with_features(measured, **fields):
    return measured._replace(features=measured.features._replace(**fields))


@pytest.fixture
def nothing_compiles(monkeypatch):
    """The filter itself must not be reached."""

    def reached(*_):
        raise AssertionError("the inputs were taken")

    monkeypatch.setattr(slam_filter, "_run", reached)
    monkeypatch.setattr(slam_filter, "_compiled_step", reached)


def run(measured, params=NOISE, config=CONFIG):
    return slam_filter.run_filter(config, params, init(CONFIG, [0.0, 0.0, 0.0]), measured)


def step(measured, params=NOISE, config=CONFIG):
    return slam_filter.step(config, params, init(CONFIG, [0.0, 0.0, 0.0]), measured)


ONE, LOG = measurements(), measurements(T)
KNOWN = LOG._replace(landmark_ids=np.tile([0, 2, -1], (T, 1)))


@pytest.mark.parametrize(
    "measured, message",
    [
        (
            ONE._replace(odometry=[0.1, 0.2]),
            r"measurement.odometry is float64 \(2,\), not .*\(3,\)",
        ),
        (
            ONE._replace(odometry=["a", "b", "c"]),
            r"measurement.odometry is <U1 \(3,\), not numbers",
        ),
        (ONE._replace(odometry=[[0.0], [0.0, 1.0]]), "measurement.odometry is not an array"),
        (ONE._replace(features=None), "measurement.features is NoneType, not Features"),
        (ONE.features, "measurement is Features, not Measurement"),
        (
            with_features(ONE, xy=np.zeros((M, 3))),
            r"measurement.features.xy is float64 \(3, 3\), not floating \(3, 2\)",
        ),
        (
            with_features(ONE, kind=np.zeros(M)),
            r"measurement.features.kind is float64 \(3,\), not integer \(M,\)",
        ),
        (
            with_features(ONE, valid=np.ones(M)),
            r"measurement.features.valid is float64 \(3,\), not bool \(3,\)",
        ),
        (with_features(ONE, kind=np.zeros(0, int)), "measurement.features holds no feature, M = 0"),
        (
            ONE._replace(landmark_ids=[0, 1]),
            r"measurement.landmark_ids is int64 \(2,\), not integer \(3,\)",
        ),
        (
            ONE._replace(landmark_ids=[0, 1, 6]),
            "measurement.landmark_ids holds 6, not -1 or a land",
        ),
        (ONE._replace(landmark_ids=[0, 1, -2]), "measurement.landmark_ids holds -2, not -1 or"),
        (
            ONE._replace(scan_match=scan_matches()),
            "params.scan_match_std_scale is None, but measurement.scan_match is given",
        ),
    ],
)
def test_a_step_refuses_a_wrong_measurement(measured, message, nothing_compiles):
    with pytest.raises(ValueError, match=message):
        step(measured)


@pytest.mark.parametrize(
    "measured, message",
    [
        (
            LOG._replace(odometry=np.zeros((T, 2))),
            r"measurements.odometry is float64 \(4, 2\), not",
        ),
        (LOG._replace(odometry=np.zeros(3)), r"measurements.odometry is float64 \(3,\), not"),
        (
            LOG._replace(odometry=np.zeros((T + 1, 3))),
            r"measurements.features.kind is int64 \(4, 3\), not integer \(5, M\)",
        ),
        (
            with_features(LOG, descriptor=np.zeros((T - 1, M))),
            r"measurements.features.descriptor is float64 \(3, 3\), not floating \(4, 3\)",
        ),
        (
            KNOWN._replace(landmark_ids=np.arange(12).reshape(T, M)),
            r"measurements.landmark_ids holds 11, not .* below the belief's 6 \(max_landmarks\)",
        ),
        (
            LOG._replace(landmark_ids=np.zeros((T, M))),
            r"measurements.landmark_ids is float64 \(4, 3\), not integer \(4, 3\)",
        ),
    ],
)
def test_a_run_refuses_wrong_measurements(measured, message, nothing_compiles):
    with pytest.raises(ValueError, match=message):
        run(measured)


def test_scan_matches_are_refused_where_they_do_not_fit(nothing_compiles):
    with pytest.raises(ValueError, match="std_scale is None, but measurements.scan_match is given"):
        run(LOG._replace(scan_match=scan_matches(T)), NOISE)
    wrong = scan_matches(T)._replace(information=np.zeros((T, 2, 2)))
    with pytest.raises(ValueError, match=r"measurements.scan_match.information is .*\(4, 2, 2\)"):
        run(LOG._replace(scan_match=wrong), MATCHED)
    with pytest.raises(ValueError, match="measurements.scan_match is tuple, not ScanMatch"):
        run(LOG._replace(scan_match=tuple(scan_matches(T))), MATCHED)


@pytest.mark.parametrize(
    "field, value, message",
    [
        ("odometry_coefficients", [0.1, 0.1], r"is float64 \(2,\), not floating \(4,\)"),
        (
            "odometry_coefficients",
            [0.1, 0.1, -0.1, 0.1],
            r"is \[0.1, 0.1, -0.1, 0.1\], not non-negative and finite",
        ),
        ("range_std", 0.0, "is 0.0, not positive and finite"),
        ("bearing_std", np.nan, "is nan, not positive and finite"),
        ("feature_std_scale", np.inf, "is inf, not positive and finite"),
        ("wall_angle_std", -1, "is -1.0, not positive and finite"),
        ("scan_match_std_scale", [0.3], r"is float64 \(1,\), not floating \(\)"),
        ("range_std", None, r"is object \(\), not numbers"),
    ],
)
def test_wrong_noise_parameters_are_refused(field, value, message, nothing_compiles):
    for call, measured in ((step, ONE), (run, LOG)):
        with pytest.raises(ValueError, match=f"params.{field} {message}"):
            call(measured, NOISE._replace(**{field: value}))
    with pytest.raises(ValueError, match="params is dict, not NoiseParams"):
        run(LOG, NOISE._asdict())


def test_presets_of_noise_are_valid_and_refuse_a_robot_without_wheels():
    for params in (NOISE, MATCHED, NoiseParams.for_landmark_sensor()):
        jax.tree.map(np.testing.assert_array_equal, check_params(params), params)
    none = NOISE._replace(odometry_coefficients=[0.1, 0, 0.1, 0])  # no error by rotation
    assert check_params(none).odometry_coefficients.dtype == float
    with pytest.raises(ValueError, match="wheel_base is 0.0, not positive and finite"):
        NoiseParams.for_simulated_robot(wheel_base=0.0)


@pytest.mark.parametrize(
    "fields, message",
    [
        ({"linearisation": "exact"}, "linearisation is 'exact'; known are 'standard'"),
        ({"landmark_kinds": (JUNCTION, 7)}, r"landmark_kinds is \(0, 7\), not a tuple of 0 \(JUNC"),
        ({"landmark_kinds": ()}, r"landmark_kinds is \(\), not a tuple of"),
        ({"landmark_kinds": [JUNCTION]}, "landmark_kinds is list, not hashable: give a tuple"),
        ({"max_landmarks": 0}, "max_landmarks is 0, not a whole number of at least 1"),
        ({"max_landmarks": 6.0}, "max_landmarks is 6.0, not a whole number"),
        ({"max_updates": 0}, "max_updates is 0, not a whole number of at least 1"),
        ({"confirm_count": True}, "confirm_count is True, not a whole number of at least 1"),
        ({"evict_after": -1}, "evict_after is -1, not a whole number of at least 0"),
        ({"untrusted_inflation": 0.0}, "untrusted_inflation is 0.0, not a number above 0"),
        ({"untrusted_inflation": np.inf}, "untrusted_inflation is inf, not finite"),
        ({"association": None}, "association is NoneType, not AssociationSpec"),
        ({"association": AssociationSpec(gate=0.0)}, "association.gate is 0.0, not a number above"),
        ({"association": AssociationSpec(new_gate=np.nan)}, "association.new_gate is nan, not a"),
        ({"association": AssociationSpec(verify_scans=0)}, "association.verify_scans is 0, not a"),
        ({"field_of_view": (1.0, 1.0)}, r"field_of_view is \(1.0, 1.0\), not \(first, last\)"),
        ({"field_of_view": (0.0, 7.0)}, r"field_of_view is \(0.0, 7.0\), not \(first, last\)"),
        ({"field_of_view": (0.0, np.nan)}, "field_of_view is .*, one turn at most"),
    ],
)
def test_a_wrong_configuration_is_refused_by_all_that_take_one(fields, message, nothing_compiles):
    wrong = CONFIG._replace(**fields)
    for call in (
        lambda: check_config(wrong),
        lambda: init(wrong, np.zeros(3)),
        lambda: step(ONE, config=wrong),
        lambda: run(LOG, config=wrong),
    ):
        with pytest.raises(ValueError, match=f"^(config.)?{message}"):
            call()


def test_the_configuration_of_the_whole_pipeline_is_refused_with_a_hint(nothing_compiles):
    with pytest.raises(ValueError, match="config is Config, not FilterConfig; pass config.filter"):
        run(LOG, config=Config())


@pytest.mark.parametrize(
    "pose, cov, message",
    [
        ([0.0, 0.0], None, r"pose is float64 \(2,\), not floating \(3,\)"),
        (None, None, r"pose is object \(\), not numbers"),
        (np.zeros((2, 3)), None, r"pose is float64 \(2, 3\), not"),
        (np.zeros(3), np.ones(3), r"cov is float64 \(3,\), not floating \(3, 3\)"),
        (np.zeros(3), np.diag([1.0, 1.0, np.nan]), "cov holds numbers that are not finite"),
    ],
)
def test_a_wrong_first_pose_is_refused(pose, cov, message):
    with pytest.raises(ValueError, match=message):
        init(CONFIG, pose, cov)


def test_known_landmarks_that_do_not_fit_the_belief_are_refused():
    belief, cov = init(CONFIG, np.zeros(3)), np.tile(np.eye(2), (12, 1, 1))
    with pytest.raises(ValueError, match="positions holds 12 landmarks, and the belief has 6"):
        add_known_landmarks(belief, np.zeros((12, 2)), cov)
    with pytest.raises(ValueError, match=r"positions is float64 \(2, 3\), not"):
        add_known_landmarks(belief, np.zeros((2, 3)), cov[:2])
    with pytest.raises(ValueError, match=r"cov is float64 \(3, 2, 2\), not floating \(2, 2, 2\)"):
        add_known_landmarks(belief, np.zeros((2, 2)), cov[:3])
    with pytest.raises(ValueError, match=r"kind is 2, not 0 \(JUNCTION\) or 1 \(CORNER\)"):
        add_known_landmarks(belief, np.zeros((2, 2)), cov[:2], WALL)
    full = add_known_landmarks(belief, [[1, 2], [3, 4]], cov[:2].tolist())
    np.testing.assert_array_equal(full.landmark_positions[:3], [[1, 2], [3, 4], [0, 0]])
    with pytest.raises(ValueError, match="belief has landmarks already"):
        add_known_landmarks(full, np.zeros((2, 2)), cov[:2])
    deferred = belief._replace(map_cov=defer(belief.map_cov))
    with pytest.raises(ValueError, match="belief.map_cov is deferred"):
        add_known_landmarks(deferred, np.zeros((2, 2)), cov[:2])
    with pytest.raises(ValueError, match="max_landmarks is 5, less than the 6 slots"):
        grow_belief(belief, 5)


def test_a_wrong_belief_is_refused(nothing_compiles):
    belief = init(CONFIG, np.zeros(3))
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), belief)
    with pytest.raises(ValueError, match=r"belief.mean is float64 \(2, 15\), not floating \(D,\)"):
        slam_filter.run_filter(CONFIG, NOISE, batch, LOG)
    with pytest.raises(ValueError, match="belief is ndarray, not Belief"):
        slam_filter.run_filter(CONFIG, NOISE, np.zeros(3), LOG)


def test_a_first_pose_of_integers_gives_a_belief_of_floats():
    for pose in ([1, 2, 0], np.array([1, 2, 0]), jnp.array([1, 2, 0])):
        belief = init(CONFIG, pose, [[1, 0, 0], [0, 1, 0], [0, 0, 1]])
        assert belief.mean.dtype == belief.pose_cov.dtype == belief.map_cov.dtype == float
        assert belief.pose.tolist() == [1.0, 2.0, 0.0]
    assert init(CONFIG, jnp.zeros(3, jnp.float32)).mean.dtype == jnp.float32


def lists(record):
    """The record with lists in place of NumPy arrays."""
    return jax.tree.map(lambda x: x.tolist(), record)


def single(record):
    """The record with NumPy floats in float32, integers in int16."""

    def cast(x):
        x = np.asarray(x)
        return x.astype({"f": np.float32, "i": np.int16}.get(x.dtype.kind, x.dtype))

    return jax.tree.map(cast, record)


@pytest.mark.parametrize("convert", [lists, single, lambda x: jax.tree.map(jnp.asarray, x)])
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_lists_numpy_and_jax_arrays_give_the_same(convert, dtype):
    belief = init(CONFIG, jnp.zeros(3, dtype))
    numbers = single((NOISE, KNOWN))  # that float32 holds exactly
    numbers = jax.tree.map(lambda x: x.astype(float) if x.dtype.kind == "f" else x, numbers)
    compiled = slam_filter._run._cache_size()
    first = slam_filter.run_filter(CONFIG, numbers[0], belief, numbers[1])
    second = slam_filter.run_filter(CONFIG, convert(numbers[0]), belief, convert(numbers[1]))
    assert slam_filter._run._cache_size() <= compiled + 1
    assert first[1].used.any() and first[1].pose.dtype == dtype
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_a_step_takes_lists_too():
    belief, info = step(lists(ONE), lists(jax.tree.map(np.asarray, NOISE)))
    assert info.num_new == 2 and belief.mean.dtype == float
