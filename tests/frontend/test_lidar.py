import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar, Scan
from jaxslam.frontend.lidar import beam_angles, beam_ends, field_of_view, in_free_view, to_scan

QUARTER = Lidar(num_beams=3, angle_min=0.0, angle_increment=0.25 * np.pi)
WIDE = Lidar(num_beams=360)


def test_angles_run_over_the_field_of_view():
    np.testing.assert_allclose(beam_angles(QUARTER), [0.0, 0.25 * np.pi, 0.5 * np.pi])
    np.testing.assert_allclose(field_of_view(QUARTER), [0.0, 0.5 * np.pi])


def test_beams_end_at_their_range_in_their_direction():
    scan = to_scan(QUARTER, [1.0, np.sqrt(2), 3.0])
    np.testing.assert_allclose(beam_ends(QUARTER, scan), [[1, 0], [1, 1], [0, 3]], atol=1e-12)


def test_bad_readings_become_no_return():
    lidar = Lidar(num_beams=8, range_max=5.0)
    scan = to_scan(lidar, jnp.array([1.0, jnp.nan, jnp.inf, -jnp.inf, 0.0, -1.0, 5.0, 7.0]))
    np.testing.assert_array_equal(scan.hit, [True] + 7 * [False])
    np.testing.assert_array_equal(scan.ranges, [1.0] + 7 * [5.0])


def test_raw_ranges_of_many_scans_are_taken_together():
    ranges = jnp.array([[1.0, 20.0], [jnp.nan, 2.0]])
    scans = to_scan(Lidar(num_beams=2), ranges)
    np.testing.assert_array_equal(scans.hit, [[True, False], [False, True]])


@pytest.mark.parametrize("kind", [list, np.float32, np.float64, jnp.asarray])
def test_lists_and_arrays_of_every_kind_give_the_same_scan(kind):
    expected = to_scan(QUARTER, jnp.array([1.5, 20.0, 2.25]))
    scan = to_scan(QUARTER, kind([1.5, 20.0, 2.25]))
    jax.tree.map(np.testing.assert_array_equal, scan, expected)
    assert scan.ranges.dtype == expected.ranges.dtype and scan.hit.dtype == bool
    ends = beam_ends(QUARTER, Scan(kind([1.5, 10.0, 2.25]), None))
    np.testing.assert_array_equal(ends, beam_ends(QUARTER, expected))
    np.testing.assert_array_equal(to_scan(QUARTER, [1, 2, 3]).ranges, [1.0, 2.0, 3.0])


def test_points_are_seen_before_the_ends_of_both_beams_beside_them():
    ranges = jnp.array([2.0, 2.0, 1.0])
    angle = jnp.array([0.1, 0.1, 0.9, 0.9, -0.6, 2.2])  # between beams 0 and 1, 1 and 2, outside
    distance = jnp.array([1.9, 2.1, 0.9, 1.1, 0.5, 0.5])
    points = distance[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    want = [True, False, True, False, False, False]
    np.testing.assert_array_equal(in_free_view(QUARTER, points, ranges), want)
    np.testing.assert_array_equal(
        in_free_view(QUARTER, points.reshape(2, 3, 2), ranges), np.reshape(want, (2, 3))
    )


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: to_scan(WIDE, np.zeros(361)), "ranges is float64 (361,), not floating (..., 360)"),
        (lambda: to_scan(WIDE, np.zeros(360, bool)), "ranges is bool (360,), not numbers"),
        (lambda: to_scan(WIDE, [[1.0], [1.0, 2.0]]), "ranges is not an array: its parts differ in"),
        (lambda: to_scan(np.zeros(360), WIDE), "lidar is a ndarray, not a Lidar"),
        (lambda: to_scan(Lidar(num_beams=1), [1.0]), "lidar.num_beams is 1, not an integer of at"),
        (
            lambda: beam_ends(WIDE, Scan(jnp.zeros((2, 360)), None)),
            "scan.ranges is float64 (2, 360), not floating (360,)",
        ),
    ],
)
def test_bad_arguments_are_named_while_tracing(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        jax.eval_shape(call)


def test_points_behind_the_robot_are_in_view_of_a_scanner_that_looks_there():
    """Its beams go from 120 to 240 degrees, beyond pi."""
    lidar = Lidar(5, np.radians(120.0), np.radians(30.0), 10.0, 0.01)
    angles = np.radians([100.0, 125.0, 179.0, 181.0, 235.0, -100.0])
    points = 2.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    want = [False, True, True, True, True, False]
    np.testing.assert_array_equal(in_free_view(lidar, points, np.full(5, 3.0)), want)
    np.testing.assert_array_equal(in_free_view(lidar, points, np.full(5, 1.0)), [False] * 6)
