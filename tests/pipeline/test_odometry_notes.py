import numpy as np
import pytest

from jaxslam.core.measurement import ScanMatch
from jaxslam.pipeline import odometry_notes


def matches_of(expected, weight):
    zeros = np.zeros((len(expected), 3))
    return ScanMatch(zeros, np.zeros((len(zeros), 3, 3)), zeros[:, 0], expected, zeros, weight)


@pytest.mark.parametrize(
    "scale, words", [(1 / 1.05, "5 % too long"), (1 / 0.94, "6 % too short"), (0.99, None)]
)
def test_a_wrong_scale_is_told_from_where_wheels_are_used_late_in_the_log(scale, words):
    odometry = np.tile([0.3, 0.01, 0.05], (100, 1))
    expected, weight = odometry * np.where(np.arange(100) < 50, 1.2, scale)[:, None], np.ones(100)
    expected[60:70], weight[60:70] = 2.0, 0.5
    found = odometry_notes.wrong_scale(matches_of(expected, weight), odometry)
    assert (found == ()) if words is None else (words in found[0])


def test_nothing_is_told_of_wheels_that_do_not_move_or_are_never_used():
    still = np.zeros((9, 3))
    assert odometry_notes.wrong_scale(matches_of(still, np.ones(9)), still) == ()
    assert odometry_notes.wrong_scale(matches_of(still + 1, np.zeros(9)), still + 2) == ()


def test_contradictions_are_counted():
    weight = np.ones(200)
    assert odometry_notes.contradictions(matches_of(np.zeros((200, 3)), weight)) == ()
    weight[:3] = 0.2
    found = odometry_notes.contradictions(matches_of(np.zeros((200, 3)), weight))
    assert "3 of 200 scans" in found[0]


def test_wheels_without_a_sign_are_noted_where_scans_say_the_opposite():
    odometry, weight = np.tile([0.3, 0.0, 0.0], (100, 1)), np.ones(100)
    weight[:12] = 0.0
    matches = matches_of(odometry, weight)
    assert odometry_notes.unsigned(matches, odometry) == ()
    matches.increment[:10, 0] = -0.25
    assert "at 10 scans" in odometry_notes.unsigned(matches, odometry)[0]
    matches.increment[5:10, 0] = 0.02
    assert odometry_notes.unsigned(matches, odometry) == ()
