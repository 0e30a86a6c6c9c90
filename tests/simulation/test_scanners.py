import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.frontend.lidar import beam_angles, begin_behind, field_of_view
from jaxslam.pipeline.config import Config
from jaxslam.simulation import drives, ray_casting, scanner_presets
from jaxslam.simulation.arguments import as_robot, check_lidar_of
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.scanners import (
    DEFAULT_STD,
    ErrorPiece,
    Scanner,
    check_scanner,
    digitise,
    pieces,
)
from jaxslam.simulation.worlds import World

PIECEWISE = pieces((0.2, 0.004, 0.0), (1.0, 0.002, 0.01), (4.0, 0.0, 0.02))
SCANNER = Scanner("test", 180, -math.pi, math.pi / 90, 5.0, 0.3, 6.0, range_noise=PIECEWISE)
BOX = World(jnp.array([[-2, -2, 2, -2], [2, -2, 2, 3], [2, 3, -2, 3], [-2, 3, -2, -2.0]]))


@pytest.mark.parametrize("name", scanner_presets.NAMES)
def test_presets_are_possible_and_make_a_configuration(name):
    scanner = scanner_presets.preset(name)
    check_scanner(scanner)
    check_lidar(scanner.lidar())
    Config.for_lidar(scanner.lidar()).check()
    hash(Robot(scanner=scanner))
    assert scanner.scan_rate > 0.0 and 0.0 < scanner.range_std(np.array([2.0]))[0] < 0.1
    first, last = field_of_view(scanner.lidar())
    angles = np.asarray(beam_angles(scanner.lidar()))
    np.testing.assert_allclose([first, last], [angles[0], angles[-1]], atol=1e-12)
    if scanner.full_circle:
        rolled, _ = begin_behind(scanner.lidar(), Scan(*np.zeros((2, scanner.num_beams))))
        assert rolled.angle_min == pytest.approx(-math.pi)
        assert scanner.field_of_view == pytest.approx(2 * math.pi)
    else:  # symmetric to what is ahead, up to a beam
        assert abs(first + last) <= 2 * scanner.angle_increment
        assert scanner.field_of_view == pytest.approx(last - first)


def test_presets_have_the_numbers_of_their_data_sheets():
    """Samples per second, which most sheets give on their own, follow from beams and rate."""
    per_second = {
        "LDS-01": 1800,
        "LDS-02": 2300,
        "RPLidar A1": 1980,  # 360 samples at 5.5 Hz
        "RPLidar A2": 8000,
        "RPLidar S2": 32000,
        "LD19": 4500,
        "TiM571": 16200,
        "URG-04LX": 10240,
        "UTM-30LX": 57600,
    }
    for name, samples in per_second.items():
        scanner = scanner_presets.preset(name)
        around = 2 * math.pi / scanner.angle_increment
        assert around * scanner.scan_rate == pytest.approx(samples)


@pytest.mark.parametrize("name", ["LMS-200", "lms200", "LMS 200", "lms_200"])
def test_a_preset_is_found_however_its_name_is_written(name):
    assert scanner_presets.preset(name).name == "LMS-200"


def test_an_unknown_preset_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="no scanner named 'LMS-300'; there are: LDS-01, .* S300"):
        scanner_presets.preset("LMS-300")


@pytest.mark.parametrize("convert", [np.asarray, jnp.asarray])
def test_noise_by_range_is_that_of_its_piece(convert):
    ranges = np.array([0.1, 0.2, 0.999, 1.0, 3.0, 4.0, 10.0])
    std = SCANNER.range_std(convert(ranges))
    expected = [0.004, 0.004, 0.004, 0.012, 0.032, 0.08, 0.2]
    np.testing.assert_allclose(std, expected, atol=1e-12)
    assert SCANNER.lidar() == Lidar(180, -math.pi, math.pi / 90, 6.0, pytest.approx(0.032))


def test_what_is_assumed_is_said_and_what_is_given_is_taken():
    bound = pieces((0.0, 0.03, 0.003))
    plain = SCANNER._replace(range_noise=None)
    by_precision = plain._replace(precision=bound, accuracy=pieces((0.0, 0.3, 0.0)))
    by_accuracy = plain._replace(accuracy=bound)
    at = np.array([2.0])
    for scanner in (by_precision, by_accuracy):
        np.testing.assert_allclose(scanner.range_std(at), [0.012])
    assert plain.range_std(at)[0] == DEFAULT_STD
    assert SCANNER.assumptions() == ()
    assert "a third of its precision" in by_precision.assumptions()[0]
    assert "a third of its accuracy" in by_accuracy.assumptions()[0]
    assert "10 mm is assumed" in plain.assumptions()[0]


def test_reported_ranges_are_multiples_within_the_limits():
    scanner = SCANNER._replace(range_resolution=0.05)
    given = np.array([0.0, 0.26, 0.31, 1.024, 1.026, 5.94, 5.99, 7.0, 2.0])
    hit = np.array([True] * 8 + [False])
    scan = digitise(scanner, Scan(jnp.asarray(given), jnp.asarray(hit)))
    expected = [6.0, 6.0, 0.3, 1.0, 1.05, 5.95, 6.0, 6.0, 6.0]
    np.testing.assert_allclose(scan.ranges, expected, atol=1e-12)
    np.testing.assert_array_equal(scan.hit, [0, 0, 1, 1, 1, 1, 0, 0, 0])
    kept = digitise(SCANNER, Scan(jnp.asarray(given), jnp.asarray(hit)))
    np.testing.assert_array_equal(kept.ranges[2:6], given[2:6])


def test_simulated_ranges_have_the_noise_of_the_scanner():
    """Standardised errors have variance 1 at each range, with 5 standard errors."""
    lidar = SCANNER.lidar()
    trials, pose = 400, jnp.array([1.4, 0.5, 0.3])

    @jax.jit
    def scans(keys):
        def one(key):
            return drives._scan(lidar, BOX, pose, key, scanner=SCANNER).ranges

        return jax.vmap(one)(keys)

    exact = np.asarray(ray_casting.cast(lidar, BOX, pose).ranges)
    found = np.asarray(scans(jax.random.split(jax.random.key(0), trials)))
    z = (found - exact) / SCANNER.range_std(exact)
    for low, high in [(0.6, 1.0), (1.0, 4.0), (4.0, 5.0)]:
        own = z[:, (exact >= low) & (exact < high)]
        assert own.size > 2000
        assert abs(own.mean()) < 5 / np.sqrt(own.size)
        assert abs((own**2).mean() - 1) < 5 * np.sqrt(2 / own.size)


def test_the_configuration_must_have_the_scanner_of_the_robot():
    robot = as_robot(Robot(scanner=SCANNER))
    check_lidar_of(robot, SCANNER.lidar())
    check_lidar_of(robot, SCANNER.lidar()._replace(range_std=0.5))
    check_lidar_of(Robot(), Lidar())
    with pytest.raises(ValueError, match="config.frontend.lidar.num_beams is 361, .* 180; make"):
        check_lidar_of(robot, Lidar())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_beams": 1}, "scanner.num_beams is 1, not an integer of 2 or more"),
        ({"num_beams": 20.5}, "scanner.num_beams is 20.5, not an integer"),
        ({"angle_increment": 0.0}, "scanner.angle_increment is 0.0, not above 0"),
        ({"angle_increment": 0.1}, "together more than 2 pi"),
        ({"angle_min": math.nan}, "scanner.angle_min is nan, not a finite number"),
        ({"scan_rate": -5.0}, "scanner.scan_rate is -5.0, not above 0"),
        ({"scan_rate": math.inf}, "scanner.scan_rate is inf, not a finite number"),
        ({"range_min": 6.0}, r"scanner.range_min is 6.0, not in \[0, range_max\)"),
        ({"range_min": -0.1}, "scanner.range_min is -0.1, not in"),
        ({"range_min": math.nan}, "scanner.range_min is nan, not in"),
        ({"range_resolution": 0.0}, "scanner.range_resolution is 0.0, not above 0"),
        ({"beam_divergence": math.inf}, "scanner.beam_divergence is inf, not above 0"),
        ({"range_noise": ()}, r"scanner.range_noise is \(\), not one or more pieces"),
        ({"range_noise": 0.01}, "scanner.range_noise is 0.01, not a tuple of ErrorPiece"),
        ({"precision": pieces((0, -1, 0))}, "scanner.precision is .* of 0 or more"),
        ({"accuracy": PIECEWISE[::-1]}, "scanner.accuracy has pieces from .* order"),
    ],
)
def test_what_is_not_possible_is_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        check_scanner(SCANNER._replace(**change))
    with pytest.raises(ValueError, match=message):
        as_robot(Robot(scanner=SCANNER._replace(**change)))


def test_other_records_are_no_scanners():
    with pytest.raises(ValueError, match="scanner is Lidar, not Scanner"):
        check_scanner(Lidar())
    with pytest.raises(ValueError, match="robot.scanner is Lidar, not Scanner"):
        as_robot(Robot(scanner=Lidar()))
    assert ErrorPiece(0.0, 0.01, 0.0) == pieces((0.0, 0.01, 0.0))[0]
