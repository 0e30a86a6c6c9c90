"""Keys of noise parameters in files: they keep their spelling."""

import json

import jax
import numpy as np
import pytest

from jaxslam.filtering.heteroscedastic import MeasurementWeights, OdometryWeights
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import noise_file
from jaxslam.io.errors import InputError

KEYS = ["odometry", "range", "bearing", "scale", "wall", "alignment"]
OLD_FILE = {
    "format": "jaxslam-noise",
    "version": 1,
    "noise": {
        "odometry": [0.1, 0.2, 0.3, 0.4],
        "range": 0.05,
        "bearing": 0.01,
        "scale": 1.5,
        "wall": 0.03,
        "alignment": 0.3,
    },
}


def test_a_file_of_the_version_before_is_read(tmp_path):
    (tmp_path / "noise.json").write_text(json.dumps(OLD_FILE))
    params = noise_file.read(tmp_path / "noise.json", NoiseParams.for_laser_log(match_scans=True))
    np.testing.assert_allclose(params.odometry_coefficients, [0.1, 0.2, 0.3, 0.4], rtol=1e-6)
    np.testing.assert_allclose(params[1:6], [0.05, 0.01, 1.5, 0.03, 0.3], rtol=1e-6)


def test_files_are_written_with_the_same_keys(tmp_path):
    noise_file.write(tmp_path / "a.json", NoiseParams.for_laser_log(match_scans=True))
    noise_file.write(tmp_path / "b.json", NoiseParams.for_laser_log())
    for name, keys in (("a.json", KEYS), ("b.json", KEYS[:5])):
        content = json.loads((tmp_path / name).read_text())
        assert list(content) == ["format", "version", "noise"]
        assert list(content["noise"]) == keys


def test_keys_and_names_are_inverse():
    names = [*NoiseParams._fields[: len(KEYS)], "odometry_coefficients[3]", "other", "other[1]"]
    keys = [*KEYS, "odometry[3]", "other", "other[1]"]
    names, keys = [*names, "odometry_weights.turn[1]"], [*keys, "odometry_weights.turn[1]"]
    assert list(map(noise_file.key_of, names)) == keys
    assert list(map(noise_file.name_of, keys)) == names
    assert list(noise_file.to_keys(NoiseParams.for_laser_log())) == KEYS


def test_a_field_in_the_place_of_its_key_is_refused(tmp_path):
    noise = OLD_FILE["noise"] | {"range_std": 0.05}
    (tmp_path / "noise.json").write_text(json.dumps(OLD_FILE | {"noise": noise}))
    with pytest.raises(InputError, match="range_std: unknown field; the fields are odometry, ran"):
        noise_file.read(tmp_path / "noise.json", NoiseParams.for_laser_log())


FULL = NoiseParams.for_laser_log(match_scans=True)._replace(
    odometry_cov_rate=np.array([[2e-3, -1e-3, 0.0], [-1e-3, 1e-3, 0.0], [0.0, 0.0, 1e-4]]),
    odometry_weights=OdometryWeights(turn=np.array([0.1, -0.2, 0.0])),
    measurement_weights=MeasurementWeights(
        range=np.array([0.3, 0.0, 0.0]), incidence=np.array([-1.0, 0.5, 0.0])
    ),
    student_dof=np.array(4.0),
    odometry_bias_walk=np.array([0.0, 0.01, 0.02]),
    custom={"layers": [np.array([[1.0, -2.0]]), np.array([0.0])]},
)


def check_equal(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_options_are_read_without_a_template_for_them(tmp_path):
    """But for parameters of a noise model of one's own, of which the template has the form."""
    path = tmp_path / "noise.json"
    noise_file.write(path, FULL._replace(custom=None))
    plain = NoiseParams.for_laser_log(match_scans=True)
    check_equal(noise_file.read(path, plain), FULL._replace(custom=None))
    other = plain._replace(odometry_weights=OdometryWeights(turn=np.zeros(3)))
    check_equal(noise_file.read(path, other), FULL._replace(custom=None))
    noise_file.write(path, FULL)
    check_equal(noise_file.read(path, FULL._replace(student_dof=None)), FULL)
    with pytest.raises(InputError, match="custom.layers.0: unknown field; the fields are odometry"):
        noise_file.read(path, plain)


def test_a_file_without_an_option_that_is_wanted_is_refused(tmp_path):
    (tmp_path / "noise.json").write_text(json.dumps(OLD_FILE))
    template = NoiseParams.for_laser_log(match_scans=True)._replace(student_dof=np.array(3.0))
    with pytest.raises(InputError, match="student_dof: missing; add it, or tune again"):
        noise_file.read(tmp_path / "noise.json", template)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("student_dof", -1.0, "student_dof: -1.0 is not positive"),
        ("odometry_cov_rate", (-np.eye(3)).tolist(), "odometry_cov_rate: is no covariance; give a"),
        ("odometry_cov_rate", [[1.0]], r"odometry_cov_rate: is not numbers of shape \(3, 3\)"),
        ("odometry_bias_walk", [0.0, -0.1, 0.0], "odometry_bias_walk: .* is below 0; give finite"),
        (
            "measurement_weights.range",
            [0.0, 1e999, 0.0],
            "measurement_weights.range: .* not finite",
        ),
        ("measurement_weights.sun", [0.0, 0.0, 0.0], "measurement_weights.sun: unknown field; the"),
    ],
)
def test_wrong_options_are_refused_in_one_line(tmp_path, key, value, message):
    content = OLD_FILE | {"noise": OLD_FILE["noise"] | {key: value}}
    (tmp_path / "noise.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=message) as caught:
        noise_file.read(tmp_path / "noise.json", NoiseParams.for_laser_log(match_scans=True))
    assert "\n" not in str(caught.value)
