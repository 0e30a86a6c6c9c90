import importlib.util
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar
from jaxslam.filtering import config
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import lidar
from jaxslam.io.errors import InputError
from jaxslam.pipeline import offline
from jaxslam.pipeline.config import Config
from jaxslam.simulation import ray_casting, worlds
from jaxslam.viz import rerun_view
from jaxslam.viz.rerun_view import RerunView

LIDAR = Lidar(num_beams=61, angle_min=-np.pi / 2, angle_increment=np.pi / 60)
CONFIG = Config.for_lidar(
    LIDAR,
    filter=FilterConfig(
        max_landmarks=24,
        confirm_count=2,
    ),
)


@pytest.fixture(scope="module")
def drive():
    """Scans [T] of a robot that turns in a room, their times, and what `offline.run_slam` tells."""
    poses = np.stack([np.full(6, 2.5), np.full(6, 2.0), 0.1 * np.arange(6)], axis=1)
    cast = jax.jit(jax.vmap(lambda pose: ray_casting.cast(LIDAR, worlds.named("fig07"), pose)))
    scans = jax.tree.map(np.asarray, cast(jnp.asarray(poses)))
    motions = np.array([[0.0, 0.0, 0.0]] + [[0.0, 0.0, 0.1]] * 5)
    told, start = [], jnp.asarray(poses[0])
    watch = lambda *now: told.append(now)
    survey = offline.run_slam(
        CONFIG, NoiseParams.for_laser_log(), start, motions, scans, callback=watch
    )
    return 100.0 + np.arange(6.0), scans, told, survey


class Stream:
    """Stands for rerun's stream, and keeps what it is told."""

    def __init__(self, name):
        self.time, self.told, self.target = {}, [], None
        Stream.last_seen = self

    def spawn(self):
        self.target = "viewer"

    def save(self, file):
        self.target = file

    def set_time(self, name, **value):
        self.time[name] = next(iter(value.values()))

    def log(self, name, what, static=False):
        self.told.append((name, dict(self.time), what))

    def disconnect(self):
        self.closure_ends = True


@pytest.fixture
def rerun(monkeypatch):
    """A stand-in for rerun: a shape is what it was given."""
    shape = lambda *given, **look: (given, look)
    names = ("Arrows3D", "LineStrips3D", "Points3D")
    views = SimpleNamespace(RIGHT_HAND_Z_UP="z up")
    kinds = dict.fromkeys(names, shape)
    fake = SimpleNamespace(RecordingStream=Stream, ViewCoordinates=views, **kinds)
    monkeypatch.setitem(sys.modules, "rerun", fake)
    monkeypatch.setattr(rerun_view, "find_spec", lambda name: True)


def test_each_scan_is_shown_where_it_was_made(drive, rerun, tmp_path):
    times, scans, told, survey = drive
    shown = RerunView(CONFIG, times, scans, tmp_path / "run.rrd")
    for now in told:
        shown.watch(*now)
    shown.end(survey)
    stream = Stream.last_seen
    assert stream.target == tmp_path / "run.rrd" and stream.closure_ends
    seen = [(time, what) for name, time, what in stream.told if name == "world/scan"]
    assert [time for time, _ in seen] == [{"scan": k, "time": float(k)} for k in range(6)]
    for k, (_, ((points,), _)) in enumerate(seen):
        x, y, turn = np.asarray(survey.info.pose[k])
        c, s = np.cos(turn), np.sin(turn)
        own = np.asarray(lidar.beam_ends(LIDAR, jax.tree.map(lambda x: x[k], scans)))  # noqa: B023
        own = own[np.asarray(scans.hit[k])]
        assert not points[:, 2].any()
        np.testing.assert_allclose(
            points[:, :2], own @ np.array([[c, s], [-s, c]]) + [x, y], atol=1e-9
        )
    last = {name: what for name, _, what in stream.told}
    np.testing.assert_allclose(last["world/path"][0][0][0][:, :2], survey.info.pose[:, :2])
    assert len(last["world/map/arcs"][0][0]) == len(survey.topological_map.arc_lines)
    counts = np.asarray(config.confirmed(CONFIG.filter, survey.belief))
    corners = counts & (np.asarray(survey.belief.kind) == 1)
    assert corners.sum() > 2
    dots = last["world/map/corners"][0][0][:, :2]
    np.testing.assert_allclose(dots, survey.belief.landmark_positions[corners])
    # An ellipse holds what is three standard deviations off, in all directions.
    size = survey.belief.num_seen.size
    at = int(np.flatnonzero(corners)[0])
    own = np.asarray(survey.belief.map_cov).reshape(size, 2, size, 2)[at, :, at]
    off = last["world/map/corners/ellipses"][0][0][0][:, :2] - np.asarray(
        survey.belief.landmark_positions[at]
    )
    norm = np.einsum("ni,ij,nj->n", off, np.linalg.inv(own), off)
    np.testing.assert_allclose(norm, 9.0, rtol=1e-6)


def test_without_a_file_the_viewer_is_opened(drive, rerun):
    RerunView(CONFIG, drive[0], drive[1], None)
    assert Stream.last_seen.target == "viewer"


def test_without_rerun_it_is_told_what_to_install(drive, monkeypatch):
    monkeypatch.setattr(rerun_view, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'jaxslam\[view\]'"):
        RerunView(CONFIG, drive[0], drive[1], None)


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun is not installed")
def test_rerun_takes_what_it_is_told(drive, tmp_path):
    times, scans, told, survey = drive
    shown = RerunView(CONFIG, times, scans, tmp_path / "run.rrd")
    for now in told:
        shown.watch(*now)
    shown.end(survey)
    assert (tmp_path / "run.rrd").stat().st_size > 1000
