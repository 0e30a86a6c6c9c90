import json

import numpy as np
import pytest

from experiments import damaged_drives, map_warnings
from experiments.damaged_drives import FINE, LOST
from jaxslam.core.se2_np import compose


@pytest.fixture(scope="module")
def drive():
    return damaged_drives.simulate(1)


def test_a_drive_is_continuous_and_its_scans_fit(drive):
    steps = np.hypot(*np.diff(drive.poses[:, :2], axis=0).T)
    assert len(drive.poses) > 50 and steps.max() < 0.75
    assert drive.scans.ranges.shape == drive.scans.hit.shape
    assert drive.scans.hit.shape == (len(drive.poses), drive.lidar.num_beams)
    again = damaged_drives.simulate(1)
    np.testing.assert_array_equal(drive.scans.ranges, again.scans.ranges)


@pytest.mark.parametrize("damage", [*FINE.values(), *LOST.values()])
def test_small_errors_are_small_and_damage_is_large(damage, drive):
    kept, poses = damage(np.random.default_rng(2), drive.poses)
    error = damaged_drives.position_error(poses, drive.poses[kept])
    assert error < 0.2 if damage in FINE.values() else error > 0.2


def test_position_error_is_free_of_the_frame(drive):
    moved = compose(np.array([3.0, -1.0, 2.0]), drive.poses)
    assert damaged_drives.position_error(moved, drive.poses) < 1e-9


@pytest.mark.parametrize(
    "count, total, low, high", [(0, 0, 0.0, 1.0), (0, 60, 0.0, 0.0602), (57, 60, 0.8630, 0.9829)]
)
def test_wilson_intervals_are_those_of_the_books(count, total, low, high):
    np.testing.assert_allclose(map_warnings.wilson_interval(count, total), (low, high), atol=1e-4)


def test_the_experiment_writes_what_it_counts(tmp_path):
    arguments = ["--out", str(tmp_path), "--seed", "5", "--drives", "4"]
    assert map_warnings.main(arguments) == 0
    numbers = json.loads((tmp_path / "map_warnings.json").read_text())
    assert len(numbers["cases"]) == 4 and (tmp_path / "map_warnings.png").is_file()
    shares = numbers["shares"]["simulated"]
    assert shares["fine"]["cases"] == 2 and shares["lost"]["warned"] <= shares["lost"]["cases"]
