"""Which scans and relations of a log are evaluated in a map that has a part of them."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from jaxslam.cli import run_evaluation
from jaxslam.cli.run_evaluation import RecordedDrive
from jaxslam.core.logs import LaserLog, Relations
from jaxslam.core.scan import Lidar
from jaxslam.pipeline.results import SlamResult

LIDAR = Lidar(num_beams=4, angle_increment=0.1)
T = 10
TIMES = 100.0 + np.arange(T)
TRUTH = np.column_stack([np.arange(T), np.zeros(T), np.zeros(T)])


def drive_of(**given):
    log = LaserLog.from_arrays(TIMES, TRUTH * [1.5, 1, 1], np.ones((T, 4)), LIDAR)
    empty = {"reference": None, "relations": None, "dead_reckoning": {"ate_rmse_m": 9.0}}
    return RecordedDrive(Path("a.log"), log, **(empty | given))


def evaluated(piece, **given):
    """Errors and notes where scans are in these pieces, -1 for none; poses are exact."""
    piece = np.array(piece)
    poses = np.where(piece[:, None] >= 0, TRUTH, np.nan)
    own = np.flatnonzero(piece >= 0)
    info = SimpleNamespace(pose_cov=np.tile(0.01 * np.eye(3), (len(own), 1, 1)))
    rest = dict.fromkeys(("belief", "features", "topological_map", "consistency"))
    result = SlamResult(poses, poses, own, info=info, piece=piece, **rest)
    drive = drive_of(**given)
    run = SimpleNamespace(odom_poses=drive.log.odom_poses)
    here = run_evaluation.drive_in_map(run, result, drive, 0)
    numbers, error, notes = run_evaluation.errors_of(drive, here, smooth=False, at_start=False)
    return numbers, [*run_evaluation.not_used(drive, here), *notes], here


def relations(*pairs):
    t1, t2 = (np.array(x, float) + 100.0 for x in zip(*pairs, strict=True))
    return Relations(t1, t2, np.column_stack([t2 - t1, 0 * t1, 0 * t1]))


@pytest.fixture(autouse=True)
def records(monkeypatch):
    """The diagnostics are a namespace here."""
    monkeypatch.setattr(run_evaluation.jax.tree, "map", lambda f, x: x)


def test_relations_in_a_break_or_outside_of_the_map_are_left_out():
    pairs = relations((0, 2), (1, 6), (2.5, 6), (6, 8.5), (5, 9), (3.5, 7))
    numbers, notes, _ = evaluated([0, 0, 0, 0, -1, -1, 1, 1, 1, -1], relations=pairs)
    assert numbers["relations"]["used"] == 3  # (0, 2), (1, 6), and (2.5, 6)
    assert "8" not in notes[0] and "7 of its 10 scans are in this map" in notes[0]
    numbers, _, _ = evaluated([0] * T, relations=pairs)
    assert numbers["relations"]["used"] == 6 and numbers["relations"]["translation_max_m"] < 1.0


def test_what_lies_outside_of_the_map_is_noted_and_nothing_fails():
    late = relations((8, 9))
    numbers, notes, _ = evaluated([0, 0, 0] + [-1] * 7, relations=late)
    assert "relations" not in numbers and "no relation lies in this map" in notes[1]
    reference = TIMES[6:], TRUTH[6:]
    numbers, notes, _ = evaluated([0, 0, 0] + [-1] * 7, reference=reference)
    assert "ate_rmse_m" not in numbers and "no two poses in this map" in notes[1]


def test_the_odometry_is_compared_over_the_same_scans():
    reference = TIMES, TRUTH
    numbers, _, here = evaluated([0] * 6 + [-1] * 4, reference=reference)
    assert numbers["ate_rmse_m"] < 1e-9 and numbers["matched"] == 6
    assert numbers["dead_reckoning"]["matched"] == 6
    np.testing.assert_allclose(here.odometry[:, 0], 1.5 * np.arange(6))
    numbers, _, _ = evaluated([0] * T, reference=reference)
    assert numbers["dead_reckoning"] == {"ate_rmse_m": 9.0}  # that of the whole log, as it is
