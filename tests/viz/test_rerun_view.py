import importlib.util
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import CONFIG, LIDAR

from jaxslam.filtering import config
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import lidar
from jaxslam.io.errors import InputError
from jaxslam.pipeline import offline
from jaxslam.simulation import ray_casting, worlds
from jaxslam.viz import rerun_view
from jaxslam.viz.rerun_view import RerunView


@pytest.fixture(scope="module")
def drive():
    """Scans [T] of a robot that turns in a room, their times, the chunks of SLAM and its result."""
    poses = np.stack([np.full(6, 2.5), np.full(6, 2.0), 0.1 * np.arange(6)], axis=1)
    cast = jax.jit(jax.vmap(lambda pose: ray_casting.cast(LIDAR, worlds.named("fig07"), pose)))
    scans = jax.tree.map(np.asarray, cast(jnp.asarray(poses)))
    odometry = np.array([[0.0, 0.0, 0.0]] + [[0.0, 0.0, 0.1]] * 5)
    chunks, start = [], jnp.asarray(poses[0])

    def watch(state, chunk):
        chunks.append((state, chunk))

    result = offline.run_slam(
        CONFIG,
        NoiseParams.for_laser_log(),
        odometry,
        scans,
        start=start,
        match_scans=False,
        smooth=False,
        callback=watch,
    )
    return 100.0 + np.arange(6.0), scans, chunks, result


class Stream:
    """Stands for rerun's stream, and keeps what is logged."""

    def __init__(self, name):
        self.time, self.logged, self.target = {}, [], None
        Stream.latest = self

    def spawn(self):
        self.target = "viewer"

    def save(self, file):
        self.target = file

    def set_time(self, name, **value):
        self.time[name] = next(iter(value.values()))

    def log(self, name, what, static=False):
        self.logged.append((name, dict(self.time), what))

    def disconnect(self):
        self.closed = True


@pytest.fixture
def rerun(monkeypatch):
    """A stand-in for rerun: a shape is what it was given."""

    def shape(*given, **style):
        return given, style

    names = ("Arrows3D", "LineStrips3D", "Points3D")
    views = SimpleNamespace(RIGHT_HAND_Z_UP="z up")
    kinds = dict.fromkeys(names, shape)
    fake = SimpleNamespace(RecordingStream=Stream, ViewCoordinates=views, **kinds)
    monkeypatch.setitem(sys.modules, "rerun", fake)
    monkeypatch.setattr(rerun_view, "find_spec", lambda name: True)


def test_each_scan_is_shown_where_it_was_made(drive, rerun, tmp_path):
    times, scans, chunks, result = drive
    shown = RerunView(CONFIG, times, scans, tmp_path / "run.rrd")
    for state, chunk in chunks:
        shown.watch(state, chunk)
    shown.end(result)
    stream = Stream.latest
    assert stream.target == tmp_path / "run.rrd" and stream.closed
    seen = [(time, what) for name, time, what in stream.logged if name == "world/scan"]
    assert [time for time, _ in seen] == [{"scan": k, "time": float(k)} for k in range(6)]
    for k, (_, ((points,), _)) in enumerate(seen):
        x, y, turn = np.asarray(result.info.pose[k])
        c, s = np.cos(turn), np.sin(turn)
        own = np.asarray(lidar.beam_ends(LIDAR, jax.tree.map(lambda x: x[k], scans)))  # noqa: B023
        own = own[np.asarray(scans.hit[k])]
        assert not points[:, 2].any()
        np.testing.assert_allclose(
            points[:, :2], own @ np.array([[c, s], [-s, c]]) + [x, y], atol=1e-9
        )
    last = {name: what for name, _, what in stream.logged}
    np.testing.assert_allclose(last["world/path"][0][0][0][:, :2], result.info.pose[:, :2])
    assert len(last["world/map/arcs"][0][0]) == len(result.topological_map.arc_lines)
    counts = np.asarray(config.confirmed(CONFIG.filter, result.belief))
    corners = counts & (np.asarray(result.belief.kind) == 1)
    assert corners.sum() > 2
    dots = last["world/map/corners"][0][0][:, :2]
    np.testing.assert_allclose(dots, result.belief.landmark_positions[corners])
    # An ellipse holds what is three standard deviations off, in all directions.
    size = result.belief.num_seen.size
    at = int(np.flatnonzero(corners)[0])
    own = np.asarray(result.belief.map_cov).reshape(size, 2, size, 2)[at, :, at]
    off = last["world/map/corners/ellipses"][0][0][0][:, :2] - np.asarray(
        result.belief.landmark_positions[at]
    )
    norm = np.einsum("ni,ij,nj->n", off, np.linalg.inv(own), off)
    np.testing.assert_allclose(norm, 9.0, rtol=1e-6)


def test_without_a_file_the_viewer_is_opened(drive, rerun):
    RerunView(CONFIG, drive[0], drive[1], None)
    assert Stream.latest.target == "viewer"


def test_without_rerun_the_line_says_how_to_install_it(drive, monkeypatch):
    monkeypatch.setattr(rerun_view, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'jaxslam\[view\]'"):
        RerunView(CONFIG, drive[0], drive[1], None)


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun is not installed")
def test_rerun_takes_what_is_logged(drive, tmp_path):
    times, scans, chunks, result = drive
    shown = RerunView(CONFIG, times, scans, tmp_path / "run.rrd")
    for state, chunk in chunks:
        shown.watch(state, chunk)
    shown.end(result)
    assert (tmp_path / "run.rrd").stat().st_size > 1000
