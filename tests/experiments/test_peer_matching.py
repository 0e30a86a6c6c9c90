"""Peers are stood in for by functions that return what is known."""

import sys
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from experiments import peer_matching
from jaxslam.core import se2_np

POSES = np.array([[0.0, 0.0, 0.0], [0.3, 0.1, 0.4], [-2.0, 5.0, 3.0], [1.0, -1.0, -2.5]])


@pytest.fixture(scope="module")
def drive():
    return peer_matching.simulate(0, 6)


def test_poses_in_space_compose_as_in_the_plane():
    for a, b in zip(POSES, POSES[::-1], strict=True):
        both = peer_matching.in_space(a) @ peer_matching.in_space(b)
        np.testing.assert_allclose(both, peer_matching.in_space(se2_np.compose(a, b)), atol=1e-12)
        np.testing.assert_allclose(peer_matching.in_plane(peer_matching.in_space(a)), a, atol=1e-12)


def test_the_points_of_a_scan_are_at_its_ranges_in_each_plane(drive):
    flat, tall = (peer_matching.clouds(drive, heights) for heights in ((0.0,), (-1.0, 1.0)))
    assert len(flat) == len(tall) == 6
    for one, two, ranges, hit in zip(flat, tall, *map(np.asarray, drive.scans[:2]), strict=True):
        np.testing.assert_allclose(np.hypot(*one[:, :2].T), ranges[hit], rtol=1e-6)
        np.testing.assert_array_equal(two[:, :2], np.tile(one[:, :2], (2, 1)))
        assert not one[:, 2].any() and np.unique(two[:, 2]).tolist() == [-1.0, 1.0]


def test_errors_are_those_of_all_increments_but_the_first():
    truth = np.tile([0.2, 0.0, 0.1], (3, 1))
    found = truth + [[9.0, 9.0, 1.0], [0.003, 0.004, 0.0], [0.0, 0.0, 0.01]]
    error = peer_matching.errors(truth, found)
    assert error["position_max_mm"] == pytest.approx(5.0)
    assert error["position_rms_mm"] == pytest.approx(5.0 / np.sqrt(2))
    assert error["heading_rms_deg"] == pytest.approx(np.degrees(0.01 / np.sqrt(2)))


def test_scan_matching_is_closer_to_the_truth_than_wheels_that_slip(drive):
    slip = drive.odometry + [0.05, 0.03, 0.1]
    found = peer_matching.MATCHERS["jaxslam"](drive._replace(odometry=slip))()
    matched, wheels = (peer_matching.errors(drive.truth, x) for x in (found, slip))
    assert all(matched[name] < 0.3 * wheels[name] for name in wheels)


def test_a_registration_begins_with_the_motion_of_the_wheels(drive, monkeypatch):
    seen = []

    def align(before, now, *, init_T_target_source, registration_type, **_):
        seen.append((before, now, registration_type))
        return SimpleNamespace(T_target_source=init_T_target_source)

    monkeypatch.setitem(sys.modules, "small_gicp", SimpleNamespace(align=align))
    found = peer_matching.MATCHERS["small_gicp, plane ICP"](drive)()
    np.testing.assert_allclose(found[1:], drive.odometry[1:], atol=1e-12)
    points = peer_matching.clouds(drive, peer_matching.LAYER_HEIGHTS)
    assert [kind for *_, kind in seen] == 5 * ["PLANE_ICP"]
    for (before, now, _), first, second in zip(seen, points, points[1:], strict=False):
        np.testing.assert_array_equal(before, first)
        np.testing.assert_array_equal(now, second)


def test_increments_of_odometry_are_those_between_its_poses(drive, monkeypatch):
    poses = se2_np.dead_reckoning(POSES[1], drive.truth)

    class Kiss:
        def __init__(self, config):
            assert config.mapping.voxel_size == pytest.approx(drive.lidar.range_max / 100)
            assert config.registration.max_num_threads == 1 and not config.data.deskew
            self.left = list(poses)

        def register_frame(self, points, _):
            assert points.shape[1] == 3
            self.last_pose = peer_matching.in_space(self.left.pop(0))

    def config():
        return SimpleNamespace(
            **{x: SimpleNamespace() for x in ("data", "mapping", "registration")}
        )

    monkeypatch.setitem(sys.modules, "kiss_icp", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "kiss_icp.kiss_icp", SimpleNamespace(KissICP=Kiss))
    monkeypatch.setitem(sys.modules, "kiss_icp.config", SimpleNamespace(KISSConfig=config))
    found = peer_matching.MATCHERS["KISS-ICP"](drive)()
    np.testing.assert_allclose(found[1:], drive.truth[1:], atol=1e-9)


def test_the_table_has_those_that_are_installed_and_work(drive, monkeypatch, capsys):
    def exact(drive):
        return lambda: drive.truth

    def broken(drive):
        raise AttributeError("no such thing")

    missing = partial(peer_matching.import_module, "no_such_library_of_matching")
    makers = {"exact": exact, "broken": broken, "missing": lambda _: missing()}
    monkeypatch.setattr(peer_matching, "MATCHERS", makers)
    monkeypatch.setattr(peer_matching, "simulate", lambda seed, count: drive)
    found = peer_matching.table(0, 6, repeats=1)
    assert found["not_installed"] == ["missing"] and "no such thing" in found["notes"]["broken"]
    assert list(found["rows"]) == ["wheels", "exact"] and found["scans"] == 6
    assert found["rows"]["exact"]["position_max_mm"] < 1e-9 < found["rows"]["exact"]["ms_per_scan"]
    assert found["rows"]["wheels"]["position_max_mm"] > 0.0
    peer_matching.print_table(found)
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [
        *("scan", "wheels", "exact", "not", "broken:")
    ]
