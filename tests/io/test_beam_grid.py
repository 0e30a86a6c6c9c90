import numpy as np
import pytest

from jaxslam.io import beam_grid
from jaxslam.io.raw_log import RawScan

FULL = 2 * np.pi


def wall(angle):
    """Range of a smooth closed wall in a direction, seen from above."""
    return 3.0 + np.cos(angle) + 0.5 * np.sin(2 * angle)


def scan_of(first, step, count, *, upside_down=False, see=wall):
    """A scan of the wall by a scanner that may hang upside down."""
    angles = first + step * np.arange(count)
    seen = -angles if upside_down else angles
    return RawScan(0.0, np.nan, 0, "laser", first, step, np.inf, see(seen))


def angles_of(grid):
    return grid.angle_min + grid.angle_increment * np.arange(grid.num_beams)


def assert_sees_the_wall(ranges, grid, *, least, within=0.5):
    """All finite readings are those of the wall within this fraction of a step, `least` of them."""
    angles = angles_of(grid)
    finite = np.isfinite(ranges)
    assert finite.mean() >= least
    error = np.abs(ranges - wall(angles))[finite]
    assert error.max() <= 2.0 * grid.angle_increment * within + 1e-9


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize(
    "first, last",
    [(-np.pi / 2, np.pi / 2), (np.pi / 2, -np.pi / 2), (-np.pi, np.pi - 0.02), (0.1, 2.0)],
)
def test_scans_of_one_geometry_keep_their_beams(first, last, upside_down):
    one = scan_of(first, (last - first) / 90, 91, upside_down=upside_down)
    ranges, grid, notes = beam_grid.to_grid([one] * 3, upside_down=upside_down)
    assert notes == [] and ranges.shape == (3, 91) and grid.angle_increment > 0
    assert sorted(ranges[0]) == sorted(one.ranges)
    np.testing.assert_allclose(ranges[1], wall(angles_of(grid)), atol=1e-12)


@pytest.mark.parametrize("first", [0.0, 1.0, -2.0, np.pi, 5.0, -FULL])
@pytest.mark.parametrize("step", [FULL / 120, -FULL / 120])
@pytest.mark.parametrize("upside_down", [False, True])
def test_a_full_turn_begins_near_minus_pi_wherever_its_seam_is(first, step, upside_down):
    one = scan_of(first, step, 120, upside_down=upside_down)
    ranges, grid, notes = beam_grid.to_grid([one], upside_down=upside_down)
    assert notes == [] and grid.num_beams == 120
    assert -np.pi - 0.5 * abs(step) <= grid.angle_min <= -np.pi + 1.01 * abs(step)
    np.testing.assert_allclose(ranges[0], wall(angles_of(grid)), atol=1e-9)


def test_a_beam_that_is_there_twice_at_the_seam_is_left_out():
    ranges, grid, _ = beam_grid.to_grid([scan_of(0.0, FULL / 120, 121)])
    assert grid.num_beams == 120
    np.testing.assert_allclose(ranges[0], wall(angles_of(grid)), atol=1e-9)


def test_a_part_of_a_turn_behind_the_robot_goes_on_beyond_pi():
    ranges, grid, _ = beam_grid.to_grid([scan_of(2.0 + FULL, 0.02, 100)])
    assert grid.num_beams == 100 and grid.angle_min == pytest.approx(2.0)
    np.testing.assert_allclose(ranges[0], wall(angles_of(grid)), atol=1e-9)


def test_counts_that_vary_are_put_on_one_grid():
    rng = np.random.default_rng(0)
    scans = [scan_of(0.0, FULL / (n - 1), n) for n in rng.integers(440, 470, 50)]
    ranges, grid, notes = beam_grid.to_grid(scans)
    assert ranges.shape == (50, grid.num_beams) and abs(grid.num_beams - 454) < 8
    for one in ranges:
        assert_sees_the_wall(one, grid, least=0.99, within=1.0)
    assert len(notes) == 1 and "beams: they are put on one grid of" in notes[0]


def test_a_few_scans_of_another_step_are_unusual_and_many_are_not():
    usual, odd = scan_of(-1.0, 0.1, 20), scan_of(-1.0, 0.11, 20)
    right = [False, *[True] * 9]
    np.testing.assert_array_equal(beam_grid.are_usual([odd, *[usual] * 9]), right)
    assert beam_grid.are_usual([odd] * 3 + [usual] * 9).all()
    assert beam_grid.are_usual([odd]).all() and beam_grid.are_usual([odd, usual]).all()
    motor = [scan_of(0.0, FULL / n, n) for n in (453, 454, 455, 456, 457)]
    assert beam_grid.are_usual(motor).all()


def test_a_single_odd_scan_does_not_change_the_grid():
    usual = scan_of(-np.pi, FULL / 360, 360)
    scans = [scan_of(-np.pi, FULL / 319, 319), *[usual] * 40]
    ranges, grid, _ = beam_grid.to_grid(scans)
    assert grid == (360, pytest.approx(-np.pi), pytest.approx(FULL / 360))
    np.testing.assert_array_equal(ranges[1:], np.tile(usual.ranges, (40, 1)))
    assert_sees_the_wall(ranges[0], grid, least=1.0, within=0.75)


def test_a_beam_that_is_lost_for_good_has_no_return():
    long, short = scan_of(-1.5, 0.1, 31), scan_of(-1.5, 0.1, 30)
    ranges, grid, _ = beam_grid.to_grid([long] * 4 + [short] * 6)
    assert grid.num_beams == 31 and np.isinf(ranges[4:, -1]).all()
    np.testing.assert_array_equal(ranges[:4], np.tile(long.ranges, (4, 1)))
    np.testing.assert_array_equal(ranges[4:, :-1], np.tile(short.ranges, (6, 1)))


def test_no_reading_is_invented_between_beams_that_are_far_apart():
    fine, coarse = scan_of(-1.0, 0.01, 201), scan_of(-1.0, 0.04, 51)
    ranges, grid, _ = beam_grid.to_grid([fine] * 9 + [coarse])
    assert np.isfinite(ranges[-1]).sum() == 51 and grid.num_beams == 201
    np.testing.assert_array_equal(ranges[-1, ::4], coarse.ranges)


def test_last_digits_of_the_step_that_differ_move_no_beam():
    rng = np.random.default_rng(1)
    scans = [scan_of(-2.0, 0.0174533 + 1e-7 * x, 230) for x in rng.normal(size=30)]
    ranges, grid, notes = beam_grid.to_grid(scans)
    assert grid.num_beams == 230 and "differ in their angles" in notes[0]
    np.testing.assert_array_equal(ranges, np.array([one.ranges for one in scans]))


def test_the_step_can_be_given():
    one = scan_of(np.pi / 2, -0.0176, 180)
    _, grid, _ = beam_grid.to_grid([one], angle_increment=0.0174)
    assert grid.angle_increment == 0.0174 and grid.angle_min == pytest.approx(
        np.pi / 2 - 179 * 0.0174
    )
