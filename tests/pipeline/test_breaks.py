import numpy as np
import pytest

from jaxslam.core.measurement import ScanMatch
from jaxslam.pipeline.breaks import first_break, pauses

N = 9


def matches_of(**changed):
    """Scans that fit well and move as the wheels say, but for one number of each field given."""
    fields = {
        "increment": np.tile([0.2, 0.0, 0.0], (N, 1)),
        "information": np.zeros((N, 3, 3)),
        "inlier_fraction": np.full(N, 0.9),
        "expected": np.tile([0.2, 0.0, 0.0], (N, 1)),
        "expected_variance": np.zeros((N, 3)),
        "odometry_weight": np.ones(N),
    }
    for name, (index, value) in changed.items():
        fields[name][index] = value
    return ScanMatch(**fields)


def broken_at(matches, pause=4, use_odometry=True, returns=90):
    after_pause = np.arange(N) == pause
    return first_break(matches, np.full(N, returns), after_pause, use_odometry=use_odometry)


def test_a_pause_is_an_interval_much_longer_than_usual_and_of_some_seconds():
    times = np.cumsum([0.0, 1.0, 1.0, 9.0, 1.0, 4.0, 1.0])
    np.testing.assert_array_equal(np.flatnonzero(pauses(times)), [3])
    assert not pauses(times / 10).any()
    assert not pauses(times[:1]).any() and not pauses(np.zeros(5)).any()
    back = np.array([5.0, 6.0, 5.5, 6.5])
    assert not pauses(back).any()


@pytest.mark.parametrize(
    "changed, found",
    [
        ({}, None),
        ({"odometry_weight": (4, 0.1)}, 4),
        ({"inlier_fraction": (4, 0.25)}, 4),
        ({"odometry_weight": (3, 0.1)}, None),
        ({"inlier_fraction": (3, 0.25)}, None),
        ({"inlier_fraction": (3, 0.1)}, 3),
        ({"inlier_fraction": (3, 0.35), "odometry_weight": (3, 0.7)}, 3),
        ({"inlier_fraction": (3, 0.35), "odometry_weight": (2, 0.7)}, None),
    ],
)
def test_the_first_scan_after_a_pause_breaks_the_drive_where_it_does_not_fit(changed, found):
    assert broken_at(matches_of(**changed)) == found


def test_without_wheels_a_pause_in_which_the_robot_moved_is_a_break():
    assert broken_at(matches_of(), use_odometry=False) is None
    assert broken_at(matches_of(increment=(4, [0.2, 0.0, 1.0])), use_odometry=False) == 4
    assert broken_at(matches_of(increment=(4, [0.2, 0.4, 0.0])), use_odometry=False) == 4


def test_scans_without_returns_show_no_place():
    assert broken_at(matches_of(inlier_fraction=(3, 0.0)), returns=5) is None
