"""Keys of noise parameters in files: they keep their spelling."""

import json

import numpy as np
import pytest

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
    np.testing.assert_allclose(params[1:], [0.05, 0.01, 1.5, 0.03, 0.3], rtol=1e-6)


def test_files_are_written_with_the_same_keys(tmp_path):
    noise_file.write(tmp_path / "a.json", NoiseParams.for_laser_log(match_scans=True))
    noise_file.write(tmp_path / "b.json", NoiseParams.for_laser_log())
    for name, keys in (("a.json", KEYS), ("b.json", KEYS[:5])):
        content = json.loads((tmp_path / name).read_text())
        assert list(content) == ["format", "version", "noise"]
        assert list(content["noise"]) == keys


def test_keys_and_names_are_inverse():
    names = [*NoiseParams._fields, "odometry_coefficients[3]", "other", "other[1]"]
    keys = [*KEYS, "odometry[3]", "other", "other[1]"]
    assert list(map(noise_file.key_of, names)) == keys
    assert list(map(noise_file.name_of, keys)) == names
    assert list(noise_file.to_keys(NoiseParams.for_laser_log())) == KEYS


def test_a_field_in_the_place_of_its_key_is_refused(tmp_path):
    noise = OLD_FILE["noise"] | {"range_std": 0.05}
    (tmp_path / "noise.json").write_text(json.dumps(OLD_FILE | {"noise": noise}))
    with pytest.raises(InputError, match="range_std: unknown field; the fields are odometry, ran"):
        noise_file.read(tmp_path / "noise.json", NoiseParams.for_laser_log())
