import numpy as np
import pytest

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import compose, dead_reckoning, increments, transform
from jaxslam.mapping.map_consistency import check_map
from jaxslam.matching.scan_agreement import (
    CONFIRMED,
    CONTRADICTED,
    HIDDEN,
    OUT_OF_VIEW,
    PosedScans,
    ScanComparison,
    posed_scans,
)
from jaxslam.simulation.worlds import outline

LIDAR = Lidar(num_beams=181, angle_min=-np.pi / 2, angle_increment=np.pi / 180, range_max=30.0)
# A ring of corridors around a block, with a niche on each side.
RING = outline(
    [(0, 0, 14, 10), (5, -0.6, 7, 0), (14, 4, 14.8, 5), (4, 10, 5, 11), (-0.5, 6, 0, 8)],
    [(2, 2, 12, 8), (9, 0, 9.4, 0.4)],
)
CORNERS = np.array([(1, 1), (13, 1), (13, 9), (1, 9)], float)


def lap(rounds=1.5, step=0.25):
    """Poses (T, 3) of a drive around the ring, which turns on the spot at its corners."""
    poses = []
    for leg in range(int(4 * rounds)):
        start, end = CORNERS[leg % 4], CORNERS[(leg + 1) % 4]
        heading = leg * np.pi / 2
        for part in np.arange(0.0, 1.0, step / np.hypot(*(end - start))):
            poses.append((*(start + part * (end - start)), heading))
        poses += [(*end, heading + turn) for turn in (0.0, 0.5, 1.0)]
    return np.array(poses)


def cast(poses, walls=RING):
    """Noise-free scans [T] of walls (S, 4)."""
    angle = poses[:, 2:] + LIDAR.angle_min + LIDAR.angle_increment * np.arange(LIDAR.num_beams)
    beam = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, :, None]
    start, along = walls[:, :2] - poses[:, None, None, :2], walls[:, 2:] - walls[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = beam[..., 0] * along[:, 1] - beam[..., 1] * along[:, 0]
        distance = (start[..., 0] * along[:, 1] - start[..., 1] * along[:, 0]) / slope
        part = (start[..., 0] * beam[..., 1] - start[..., 1] * beam[..., 0]) / slope
        met = (distance > 1e-6) & (np.abs(part - 0.5) <= 0.5 + 1e-6)
    ranges = np.where(met, distance, np.inf).min(axis=-1)
    hit = ranges < LIDAR.range_max
    return Scan(np.where(hit, ranges, LIDAR.range_max), hit)


POSES = lap()
SCANS = cast(POSES)


def test_a_perfect_drive_has_no_warning():
    found = check_map(LIDAR, POSES, SCANS)
    numbers = found.metrics()
    assert numbers["warnings"] == [] and numbers["explained"] == 1.0
    assert numbers["walls_median_m"] < 1e-6 and numbers["walls_p90_m"] < 0.01
    assert np.isfinite(found.visit_contradiction).sum() > 50  # the second lap


def test_rigid_motion_of_the_trajectory_changes_nothing():
    steps = increments(POSES)
    steps[70, 2] += 0.4
    poses = dead_reckoning(POSES[0], steps)
    frame = np.array([20.0, -7.0, 2.0])
    one, other = check_map(LIDAR, poses, SCANS), check_map(LIDAR, compose(frame, poses), SCANS)
    assert one.warnings
    for a, b in zip(one.warnings, other.warnings, strict=True):
        assert (a.first_scan, a.last_scan) == (b.first_scan, b.last_scan)
        np.testing.assert_allclose(transform(frame, np.array([a.x, a.y])), [b.x, b.y], atol=1e-6)
    np.testing.assert_array_equal(one.explained, other.explained)


@pytest.mark.parametrize("jump", [-0.5, 0.35, 1.0])
@pytest.mark.parametrize("at", [30, 95])
def test_a_lost_heading_is_found_at_its_scan(at, jump):
    """Even on the first lap, before any place is seen twice."""
    steps = increments(POSES)[:110]
    steps[at, 2] += jump
    poses = dead_reckoning(POSES[0], steps)
    found = check_map(LIDAR, poses, Scan(SCANS.ranges[:110], SCANS.hit[:110]))
    warning = found.warnings[0]
    assert at - 3 <= warning.first_scan < at <= warning.last_scan <= at + 3
    assert np.hypot(*(poses[at, :2] - [warning.x, warning.y])) < 0.6
    assert "scans before them" in str(warning) and f"{warning.first_scan}-" in str(warning)


def test_a_robot_that_was_carried_is_found():
    kept = np.delete(np.arange(len(POSES)), slice(40, 79))
    steps = increments(POSES)[kept]
    steps[40] = 0.0
    poses = dead_reckoning(POSES[0], steps)
    found = check_map(LIDAR, poses, Scan(SCANS.ranges[kept], SCANS.hit[kept]))
    assert any(w.first_scan <= 40 <= w.last_scan + 1 for w in found.warnings)


def test_a_double_wall_is_found_where_it_is_seen_again():
    """The second lap drifts sideways, too little in any step to be seen between neighbours."""
    poses = POSES.copy()
    second = np.arange(len(poses)) > 190
    poses[:, :2] += 0.6 * np.clip((np.arange(len(poses)) - 100) / 90, 0, 1)[:, None]
    found = check_map(LIDAR, poses, SCANS)
    assert found.metrics()["walls_p90_m"] > 0.4
    assert found.warnings and all("m from where scan" in w.reason for w in found.warnings)
    assert any(second[w.first_scan : w.last_scan + 1].any() for w in found.warnings)


def test_small_errors_do_not_alarm():
    noise = np.random.default_rng(0).normal(0.0, [0.03, 0.03, 0.008], POSES.shape)
    assert not check_map(LIDAR, compose(POSES, noise), SCANS).warnings


def test_people_do_not_alarm():
    rng = np.random.default_rng(1)
    ranges, people = SCANS.ranges.copy(), rng.uniform(-2.0, 2.0, (3, 2))
    bearings = LIDAR.angle_min + LIDAR.angle_increment * np.arange(LIDAR.num_beams)
    for scan in ranges:
        people = np.clip(people + rng.normal(0.0, 0.15, people.shape), -3.0, 3.0)
        for x, y in people:
            distance = max(0.5, np.hypot(x, y))
            body = np.abs(np.angle(np.exp(1j * (bearings - np.arctan2(y, x))))) < 0.25 / distance
            scan[body] = np.minimum(scan[body], distance - 0.2)
    assert not check_map(LIDAR, POSES, Scan(ranges, SCANS.hit)).warnings


def test_a_door_that_was_closed_between_visits_does_not_alarm():
    """The niche of the first side is open on the first lap only."""
    closed = np.vstack([RING, [(5.0, 0.0, 7.0, 0.0)]])
    later = cast(POSES, closed)
    second = (np.arange(len(POSES)) > 150)[:, None]
    scans = Scan(np.where(second, later.ranges, SCANS.ranges), SCANS.hit | later.hit)
    assert not check_map(LIDAR, POSES, scans).warnings


def test_scans_far_apart_do_not_alarm():
    sparse = lap(step=1.0)
    assert not check_map(LIDAR, sparse, cast(sparse)).warnings


@pytest.mark.parametrize(
    "distance, first, second",
    [(2.05, CONFIRMED, CONFIRMED), (3.0, CONTRADICTED, HIDDEN), (1.5, HIDDEN, CONTRADICTED)],
)
def test_ends_of_two_scans_are_confirmed_contradicted_or_hidden(distance, first, second):
    """From one pose, the first scan sees a wall 2 m ahead and the second another."""
    angles = np.linspace(-0.5, 0.5, 61)
    ranges = np.array([[2.0], [distance]]) / np.cos(angles)
    ends = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    posed = PosedScans(np.arange(2), np.zeros((2, 3)), np.zeros(2), angles, ranges, ends)
    found = ScanComparison(posed).compare(np.array([0]), np.array([1]))
    for state, wanted in zip(found.state[0], (first, second), strict=True):
        assert set(state.tolist()) == {wanted} or set(state.tolist()) == {wanted, OUT_OF_VIEW}
    if CONTRADICTED in (first, second):
        np.testing.assert_allclose(np.nanmax(found.distance), abs(distance - 2.0), atol=0.05)


@pytest.mark.parametrize("first, count", [(-np.pi, 360), (0.0, 360), (-np.pi, 90), (0.3, 180)])
def test_a_scanner_that_sees_all_around_has_no_blind_wedge(first, count):
    lidar = Lidar(count, first, 2 * np.pi / count, 30.0)
    angles = lidar.angle_min + lidar.angle_increment * np.arange(count)
    reach = np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    ranges = 3.0 / reach[None]  # of a square room, from its middle
    posed = posed_scans(lidar, np.zeros((1, 3)), ranges, ranges > 0.0).only(np.array([0, 0]))
    found = ScanComparison(posed).compare(np.array([0]), np.array([1]))
    assert set(found.state.ravel().tolist()) == {CONFIRMED}


def test_a_scan_alone_or_without_returns_says_nothing():
    empty = Scan(np.full((3, 181), 30.0), np.zeros((3, 181), bool))
    for poses, scans in ((POSES[:1], Scan(SCANS.ranges[:1], SCANS.hit[:1])), (POSES[:3], empty)):
        found = check_map(LIDAR, poses, scans)
        numbers = found.metrics()
        assert not found.warnings and numbers["walls_median_m"] is None


def test_poses_that_are_not_finite_are_left_out():
    poses = POSES.copy()
    poses[50] = np.nan
    found = check_map(LIDAR, poses, SCANS)
    assert not found.warnings and 50 not in found.scan and 51 in found.scan
    with pytest.raises(ValueError, match="no pose is finite"):
        check_map(LIDAR, np.full((2, 3), np.nan), Scan(SCANS.ranges[:2], SCANS.hit[:2]))


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="scans.ranges"):
        check_map(LIDAR, POSES[:5], SCANS)
    with pytest.raises(ValueError, match="poses"):
        check_map(LIDAR, POSES[:, :2], SCANS)


def test_many_scans_take_bounded_work():
    """Standing still, or scanning often, adds no scans to compare."""
    often = np.repeat(POSES, 20, axis=0)
    found = check_map(
        LIDAR, often, Scan(*(np.repeat(x, 20, axis=0) for x in (SCANS.ranges, SCANS.hit)))
    )
    assert len(found.scan) <= len(POSES) and not found.warnings
