"""How matched scans become pieces; the matching itself is replaced."""

import numpy as np
import pytest

from jaxslam.core.measurement import ScanMatch
from jaxslam.core.scan import Scan
from jaxslam.pipeline import chunks, stages
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.stages import Drive

T = 12
EMPTY = object()


@pytest.fixture
def pieces_of(monkeypatch):
    """First scans of the pieces of a drive, by inlier fractions (T,) of scans in one piece."""
    monkeypatch.setattr(chunks, "CHUNK", 5)

    def run(inliers, returns=90, new_drive=()):
        inliers = np.asarray(inliers, float)
        number = np.arange(T)
        hit = np.arange(100)[None] < np.broadcast_to(returns, T)[:, None]
        seen = []

        def match_chunk(config, submap, odometry, scans, guessed):
            at = odometry[:, 1].astype(int)
            at[0] = scans.ranges[0, 0]
            found = np.where(
                np.arange(len(at)) == 0 if submap is EMPTY else False, 1.0, inliers[at]
            )
            seen.append((int(at[0]), submap is EMPTY))
            zeros = np.zeros((len(at), 3))
            match = ScanMatch(
                zeros, np.zeros((len(at), 3, 3)), found, zeros, zeros, np.ones(len(at))
            )
            return object(), match

        monkeypatch.setattr(chunks, "match_chunk", match_chunk)
        odometry = np.column_stack([np.zeros(T), number, np.zeros(T)])
        ranges = np.repeat(number[:, None], 100, axis=1).astype(float)
        flags = np.zeros(T, bool)
        drive = Drive(odometry, Scan(ranges, hit), flags, flags, np.isin(number, new_drive))
        parts = list(stages._match_ahead(Config(), EMPTY, drive))
        lengths = [len(part.odometry) for part in parts]
        assert sum(lengths) == T
        starts = np.cumsum([0, *lengths[:-1]])
        found = [int(s) for s, part in zip(starts, parts, strict=True) if part.starts_piece]
        # Each piece begins with the empty submap.
        assert {k for k, empty in seen if empty} >= {0, *found}
        return found

    return run


def fit(**other):
    """Inlier fractions of scans that fit, but for some numbers."""
    inliers = np.full(T, 0.9)
    for number, value in other.items():
        inliers[int(number[1:])] = value
    return inliers


def test_a_drive_without_a_break_is_one_piece(pieces_of):
    assert pieces_of(fit()) == []


@pytest.mark.parametrize("number", [1, 4, 5, 6, 11])
def test_a_break_begins_a_piece_wherever_it_is_in_a_chunk(pieces_of, number):
    assert pieces_of(fit(**{f"s{number}": 0.1})) == [number]


def test_several_breaks_in_one_chunk_and_drives_that_begin_there(pieces_of):
    assert pieces_of(fit(s6=0.1, s8=0.1)) == [6, 8]
    assert pieces_of(fit(s7=0.1), new_drive=[3, 5]) == [3, 5, 7]


def test_scans_that_show_nothing_are_no_break_and_neither_is_the_first_one_after_them(pieces_of):
    returns = np.where(np.arange(T) < 3, 0, 90)
    assert pieces_of(fit(s1=0.0, s2=0.0, s3=0.0), returns) == []
    assert pieces_of(fit(s1=0.0, s2=0.0, s3=0.0, s8=0.1), returns) == [8]
    later = np.where(np.isin(np.arange(T), (6, 7)), 0, 90)
    assert pieces_of(fit(s6=0.0, s7=0.0), later, new_drive=[6]) == [6]
    assert pieces_of(fit(s6=0.0, s7=0.0, s8=0.0), later, new_drive=[6]) == [6]
