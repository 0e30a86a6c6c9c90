import numpy as np
import pytest

from jaxslam.io import scan_rotation

STEP, T, DT = np.radians(1.0), 300, 0.1
TIMES = 50.0 + DT * np.arange(T)


def heading(t):
    """Turns to and fro, without a period."""
    return 0.8 * np.sin(0.5 * t) + 0.5 * np.sin(1.3 * t + 1.0)


def scans(beams, turned=1.0):
    """Scans in a room of 8 x 5 m with a pillar, from its middle."""
    ranges = np.empty((T, beams))
    for k, t in enumerate(TIMES):
        angle = turned * heading(t) + STEP * (np.arange(beams) - beams // 2)
        x, y = np.cos(angle), np.sin(angle)
        with np.errstate(divide="ignore"):
            wall = np.minimum(
                np.where(x > 0, 5.0, 3.0) / np.abs(x), np.where(y > 0, 2.0, 3.0) / np.abs(y)
            )
        ranges[k] = np.where(np.abs(np.sin((angle - 0.7) / 2)) < 0.1, 1.5, wall)
    return ranges


def compare(beams, behind=0.0, turned=1.0):
    odom_times = np.arange(45.0, 85.0, 0.05)
    return scan_rotation.compare_rotations(
        TIMES - behind, scans(beams, turned), STEP, odom_times, heading(odom_times)
    )


@pytest.mark.parametrize("beams", [180, 360])
def test_turns_are_those_of_the_scanner(beams):
    turns = scan_rotation.turns_between(scans(beams)[::4], STEP)
    np.testing.assert_allclose(turns, np.diff(heading(TIMES[::4])), atol=1.5 * STEP)
    finer = scan_rotation.turns_between(np.repeat(scans(beams)[::4], 4, axis=1), STEP / 4)
    np.testing.assert_allclose(finer, turns, atol=STEP)


@pytest.mark.parametrize("beams", [180, 360])
@pytest.mark.parametrize("behind", [1.0, 3.0, -4.0])
def test_the_offset_of_a_clock_is_found(beams, behind):
    found, notes = compare(beams, behind)
    assert found == pytest.approx(behind, abs=0.1)
    assert "by the turns that both see: the scans are moved" in notes[0]


def test_clocks_that_agree_and_delays_are_left_alone():
    for behind in (0.0, 0.3, -0.3):
        assert compare(360, behind) == (0.0, [])


def test_a_scanner_that_turns_the_other_side_is_noted():
    found, notes = compare(360, turned=-1.0)
    assert found == 0.0 and "upside down" in notes[0]


def test_without_turns_or_with_few_scans_nothing_is_said():
    odom = np.linspace(40, 90, 99)
    still = np.tile(scans(180)[:1], (T, 1))
    given = (STEP, odom, heading(odom))
    assert scan_rotation.compare_rotations(TIMES, still, *given) == (0.0, [])
    assert scan_rotation.compare_rotations(TIMES[:30], scans(180)[:30], *given) == (0.0, [])
    assert scan_rotation.compare_rotations(TIMES[:1], scans(180)[:1], *given) == (0.0, [])
    noise = np.random.default_rng(0).uniform(1, 9, (T, 180))
    assert scan_rotation.compare_rotations(TIMES, noise, *given) == (0.0, [])
