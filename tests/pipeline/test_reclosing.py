"""Drives whose wheels and scans were both wrong: closed where they show places twice."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from office_drive import CONFIG, PARAMS, office_drive, scans_along, take

from jaxslam.core.se2_np import increments
from jaxslam.mapping.map_consistency import MapConsistency
from jaxslam.mapping.map_warnings import MapWarning
from jaxslam.matching.revisits import Revisits
from jaxslam.pipeline import offline, reclosing
from jaxslam.simulation.worlds import World, outline

# A ring of corridors, bare along their middle, with niches near the corners.
BOXES = [(0, 0, 40, 16), (5, -0.6, 7, 0), (40, 3, 40.8, 4), (33, 16, 34, 17), (-0.5, 12, 0, 14)]
BLOCKS = [(2, 2, 38, 14), (3, 0, 3.4, 0.4), (36.5, 15.6, 37, 16), (0, 3.0, 0.3, 3.6)]
CORNERS = np.array([(1, 1), (39, 1), (39, 15), (1, 15)], float)
MISSING = slice(67, 77)  # scans that are left out, in the middle of the first corridor


@pytest.fixture(scope="module")
def drive():
    """Poses (T, 3) of a robot that drives around one and a half times, and its scans."""
    poses = []
    for leg in range(6):
        start, end = CORNERS[leg % 4], CORNERS[(leg + 1) % 4]
        for part in np.arange(0.0, 1.0, 0.3 / np.hypot(*(end - start))):
            poses.append((*(start + part * (end - start)), leg * np.pi / 2))
        poses += [(*end, leg * np.pi / 2 + turn) for turn in (0.4, 0.8, 1.2)]
    poses = np.array(poses)
    world = World(jnp.asarray(outline(BOXES, BLOCKS)))
    return poses, scans_along(world, poses, 0)


def rmse(found, poses):
    off = found.poses[:, :2] - poses[:, :2]
    return np.sqrt(np.mean(np.sum(off**2, axis=1)))


def consistency(contradiction, warnings=0):
    """Of scans with this contradiction of earlier visits."""
    found = np.array(contradiction, float)
    steps = np.full(len(found) - 1, np.nan)
    return MapConsistency(
        scan=np.arange(len(found)),
        poses=np.zeros((len(found), 3)),
        step_contradiction=steps,
        step_confirmation=steps,
        visit_contradiction=found,
        wall_distance=np.zeros(0),
        warnings=warnings * (MapWarning(0, 1, 0.0, 0.0, ""),),
    )


@pytest.mark.parametrize(
    "new, old, expected",
    [
        (consistency(10 * [0.0]), consistency(5 * [0.0] + 5 * [0.9]), True),
        (consistency(9 * [0.0] + [0.9]), consistency(8 * [0.0] + 2 * [0.9]), True),
        (consistency(5 * [0.0] + 5 * [0.9]), consistency(5 * [0.0] + 5 * [0.9]), False),
        (consistency(10 * [0.0]), consistency(10 * [0.0]), False),
        (consistency(10 * [0.0]), consistency(10 * [0.0], warnings=1), True),
        (consistency(10 * [0.0], warnings=2), consistency(9 * [0.0] + [0.9], warnings=1), False),
        # Torn apart, nothing is contradicted.
        (consistency(2 * [0.0] + 8 * [np.nan]), consistency(5 * [0.0] + 5 * [0.9]), False),
    ],
)
def test_a_map_is_better_that_contradicts_itself_less_and_compares_as_much(new, old, expected):
    assert reclosing._is_better(new, old) == expected


def test_notes_have_the_numbers_of_the_scans_and_name_the_saved_map():
    result = SimpleNamespace(keyframes=np.arange(100, 150), saved_poses=np.zeros((40, 3)))
    found = Revisits(
        first=np.array([3, 5, 41, 42, 39, 44]),
        second=np.array([60, 62, 70, 71, 80, 81]),
        relative_pose=np.zeros((6, 3)),
        group=np.array([0, 0, 1, 1, 2, 2]),
    )
    saved, own, both = reclosing._notes(result, found)
    assert saved.startswith("scans 120-122 show places that the saved map showed")
    assert own.startswith("scans 130-131 show places that scans 101-102 showed")
    assert both.startswith("scans 140-141 show places that scans 104-104 and the saved map showed")


@pytest.mark.slow
def test_a_step_that_looks_too_long_for_what_the_scans_show_is_found(drive, monkeypatch):
    # Where scans are missing in a bare corridor, the motion seems to be that of the scans before.
    poses, scans = drive
    kept = np.delete(np.arange(len(poses)), MISSING)
    poses, scans = poses[kept], take(scans, kept)
    before, close_again = [], reclosing.close_again

    def closed(run, filtered, result):
        before.append(result)
        return close_again(run, filtered, result)

    monkeypatch.setattr(reclosing, "close_again", closed)
    found = offline.run_slam(CONFIG, PARAMS, increments(poses), scans, start=poses[0])
    assert "closed by" in found.notes[-1] and found.consistency.explained.mean() > 0.995
    assert rmse(found, poses) < 0.5
    (as_it_was,) = before
    assert rmse(as_it_was, poses) > 1.5 and "closed by" not in "".join(as_it_was.notes)


@pytest.mark.slow
def test_what_does_not_make_the_map_better_is_not_taken(monkeypatch):
    poses, scans = office_drive()
    monkeypatch.setattr(reclosing, "is_contradicted", lambda _: True)
    looked = []

    def find_wrong(spec, scan_map):
        """Pairs that are metres from where they are said to be."""
        looked.append(scan_map)
        first = np.arange(20, 60, 5)
        wrong = np.tile([3.0, -2.0, 0.3], (len(first), 1))
        return Revisits(first, first + 150, wrong, 0 * first)

    monkeypatch.setattr(reclosing, "find_revisits", find_wrong)
    found = offline.run_slam(CONFIG, PARAMS, increments(poses), scans, start=poses[0])
    assert len(looked) == 1 and "closed by" not in "".join(found.notes)
    assert rmse(found, poses) < 0.05
