import re
import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import benchmark, common, estimator, filters, peers, start, workload
from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Scan
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import FilterConfig, init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract
from jaxslam.frontend.automaton import expand
from jaxslam.io import readers
from jaxslam.pipeline.config import Config

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import filterpy.kalman  # noqa: F401

LAPACK = r"lapack|= (cholesky|triangular_solve|eigh?|svd|lu|qr|householder_product|schur)\b"


def short(runs, steps):
    drive = workload.rings(0, runs)
    cut = {k: getattr(drive, k)[:, :steps] for k in ("truth", "motion", "polar", "who", "r")}
    return drive._replace(**cut)


def test_without_the_c_program_its_figures_are_null_and_a_note_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "YARDSTICK", tmp_path / "none.c")
    monkeypatch.setattr(peers, "SIZE", 16)
    numbers = peers.automaton(maps=2, repeats=1)
    assert numbers["automaton_vs_c"] is None and numbers["automaton_batch_vs_c"] is None
    assert numbers["ms_per_map"]["c"] is None and numbers["ms_per_map"]["batch"] > 0
    assert "none.c" in numbers["note"]


def test_what_does_not_compile_is_told(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "bad.c").write_text("this is no C")
    rival = peers.compiled(tmp_path / "in" / "bad.c", tmp_path)
    assert rival.program is None and "not compared" in rival.note


@pytest.mark.parametrize("maps, moves", [(peers.scattered, False), (peers.distant, True)])
def test_fronts_of_the_maps_settle_early_or_never(maps, moves):
    labels = maps(1)[0]
    assert 2 <= np.count_nonzero(labels) <= 200
    last = np.asarray(expand(labels, labels == 0, steps=peers.STEPS).arrival).max()
    assert (last == peers.STEPS) is np.bool_(moves) or last < peers.STEPS // 2


def test_the_stages_are_those_of_the_front_end():
    config = benchmark.slam.Config()
    scans = benchmark.Scan(jax.numpy.full((2, 361), 3.0), jax.numpy.ones((2, 361), bool))
    calls = benchmark.stages(config, scans)
    (start,) = calls["automaton"][1:]
    assert start.shape == (2, *config.frontend.grid.shape)


def test_the_filter_equals_filterpy_and_its_gradient_equals_differences():
    drive = short(runs=2, steps=12)
    ours, std = workload.as_floats(drive, np.float64), jnp.array(filters.STD)
    for k, pose in enumerate(estimator.filtered(ours).last_pose):
        theirs = filters.filterpy_track(np.array(std), workload.Drive(*(x[k] for x in drive)))
        np.testing.assert_allclose(pose[:, :2], theirs, rtol=0, atol=1e-9)
    _, slope = estimator.gradient(std, ours)
    for k in range(5):
        step = jnp.zeros(5).at[k].set(1e-5)
        high, low = (estimator.gradient(std + sign * step, ours)[0] for sign in (1.0, -1.0))
        np.testing.assert_allclose(slope[k], (high - low) / 2e-5, rtol=1e-5, atol=1e-9)


def test_two_devices_filter_as_one_does_and_do_not_hang(tmp_path, monkeypatch):
    monkeypatch.setattr(estimator, "LIMIT", 120.0)
    ends = []
    for count in (1, 2):
        done = estimator.apart(
            *("devices", str(tmp_path)), devices=count, seed=0, runs=4, repeats=1, pinned=False
        )
        assert done.get("devices") == count, done
        ends.append(done["ends"])
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-5)


def test_what_takes_too_long_or_fails_is_told(tmp_path, monkeypatch):
    assert "failed" in estimator.apart("memory", str(tmp_path), wrong=1)["memory_note"]
    monkeypatch.setattr(estimator, "LIMIT", 0.01)
    assert "longer" in estimator.apart("memory", str(tmp_path))["memory_note"]


def test_peers_that_are_missing_or_broken_are_told(monkeypatch):
    def missing():
        raise ImportError("none")

    def broken():
        raise AttributeError("jax has no such thing")

    own = {"missing": missing, "broken": broken, "filterpy": filters.PEERS["filterpy"]}
    monkeypatch.setattr(filters, "PEERS", own)
    told = filters.table(workload.as_floats(short(runs=2, steps=2)))
    assert told["missing"] is None and told["broken"]["filter"] is None
    assert "no such thing" in told["broken"]["note"]
    assert told["filterpy"]["filter"]["batch"] == 2


def test_neither_filter_nor_gradient_calls_lapack():
    config = Config(
        filter=FilterConfig(
            max_landmarks=8,
        ),
    )
    noise, beams = NoiseParams.for_simulated_robot(), (config.frontend.lidar.num_beams,)
    shape = lambda x: jax.ShapeDtypeStruct((3, *x.shape), x.dtype)
    scan = Scan(jax.ShapeDtypeStruct(beams, float), jax.ShapeDtypeStruct(beams, bool))
    nodes = jax.tree.map(
        shape, jax.eval_shape(partial(extract.extract_features, config.frontend), scan)
    )
    inputs = Measurement(jax.ShapeDtypeStruct((3, 3), float), nodes)
    start = init(config.filter, jnp.zeros(3))
    run = lambda noise, inputs: slam_filter.run_filter(config.filter, noise, start, inputs)[1].pose
    slope = jax.grad(lambda noise, inputs: jnp.sum(run(noise, inputs) ** 2))
    drive = workload.as_floats(short(runs=2, steps=2), np.float64)
    std = jnp.array(filters.STD)
    calls = [(run, noise, inputs), (slope, noise, inputs), (estimator.filtered, drive)]
    for call, *given in [*calls, (estimator.gradient, std, drive)]:
        traced = jax.jit(call).trace(*given)
        assert not re.search(LAPACK, str(traced.jaxpr) + traced.lower().as_text())


@pytest.mark.parametrize("name", ["cholesky", "eigh", "svd", "inv", "qr"])
def test_a_call_of_lapack_would_be_found(name):
    traced = jax.jit(getattr(jnp.linalg, name)).trace(jnp.eye(2))
    assert re.search(LAPACK, str(traced.jaxpr)) and "lapack" in traced.lower().as_text()


def test_a_start_is_timed_until_the_bar_says_that_scans_are_mapped(tmp_path):
    wait = "import sys, time; time.sleep(0.3); "
    code = f"{wait}print('mapping', file=sys.stderr, flush=True); {wait}"
    told = start.start(tmp_path / "log", tmp_path, code)
    assert 0.3 <= told["mapped_s"] <= told["written_s"] - 0.3
    for bad in (f"{wait}raise SystemExit('no log')", "print('nothing')"):
        with pytest.raises(SystemExit, match="log: .*"):
            start.start(tmp_path / "log", tmp_path, bad)
    kinds = {kind: told for kind in ("first", "later", "traced_anew")}
    start.draw({"log": "log", "starts": kinds}, tmp_path / "start.png")
    assert (tmp_path / "start.png").stat().st_size > 1000


def test_the_log_that_is_started_with_is_the_office_drive(tmp_path):
    start.simulated(0, tmp_path / "office.npz")
    log = readers.read(tmp_path / "office.npz")
    steps = common.scene()[3]
    assert log.ranges.shape == (steps, Config().frontend.lidar.num_beams)
    assert np.isfinite(log.ranges).mean() > 0.9 and log.num_skipped == 0
    assert 70.0 < np.hypot(*np.diff(log.odom_poses[:, :2], axis=0).T).sum() < 90.0
