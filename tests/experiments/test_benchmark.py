import re
import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import (
    benchmark,
    common,
    filter_benchmark,
    life_benchmark,
    peer_automata,
    peer_filters,
    start,
    workload,
)
from jaxslam.core.measurement import Measurement
from jaxslam.core.quick_compilation import is_short
from jaxslam.core.scan import Scan
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import FilterConfig, init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract
from jaxslam.frontend.automaton import expand
from jaxslam.frontend.config import FrontendConfig
from jaxslam.io import readers
from jaxslam.pipeline.config import Config

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import filterpy.kalman  # noqa: F401

LAPACK = r"lapack|= (cholesky|triangular_solve|eigh?|svd|lu|qr|householder_product|schur)\b"


def short(num_trials, steps):
    return workload.first_steps(workload.rings(0, num_trials), steps)


def test_without_the_c_program_its_figures_are_null_and_a_note_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(peer_automata, "C_SOURCE", tmp_path / "none.c")
    monkeypatch.setattr(peer_automata, "SIZE", 16)
    numbers = peer_automata.automaton(maps=2, repeats=1)
    assert numbers["automaton_vs_c"] is None and numbers["automaton_batch_vs_c"] is None
    assert numbers["ms_per_map"]["c"] is None and numbers["ms_per_map"]["batch"] > 0
    assert "none.c" in numbers["note"]


def test_a_program_that_does_not_compile_is_reported(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "bad.c").write_text("this is no C")
    rival = peer_automata.compile_c(tmp_path / "in" / "bad.c", tmp_path)
    assert rival.program is None and "not compared" in rival.note


@pytest.mark.parametrize(
    "maps, moves", [(peer_automata.scattered, False), (peer_automata.distant, True)]
)
def test_fronts_of_the_maps_settle_early_or_never(maps, moves):
    labels = maps(1)[0]
    assert 2 <= np.count_nonzero(labels) <= 200
    last = np.asarray(expand(labels, labels == 0, steps=peer_automata.STEPS).arrival).max()
    assert (last == peer_automata.STEPS) is np.bool_(moves) or last < peer_automata.STEPS // 2


def test_the_stages_are_those_of_the_front_end():
    config = FrontendConfig()
    scans = Scan(jnp.full((2, 361), 3.0), jnp.ones((2, 361), bool))
    calls = benchmark.stages(config, scans)
    (start,) = calls["automaton"][1:]
    assert [cells.shape for cells in start] == [(2, *x.grid.shape) for x in config.pyramid()]


def test_the_filter_equals_filterpy_and_its_gradient_equals_differences():
    drive = short(2, 12)
    ours, std = workload.as_floats(drive, np.float64), jnp.array(peer_filters.STD)
    for k, pose in enumerate(filter_benchmark.filter_drive(ours).pose):
        theirs = peer_filters.filterpy_positions(
            np.array(std), workload.Drive(*(x[k] for x in drive))
        )
        np.testing.assert_allclose(pose[:, :2], theirs, rtol=0, atol=1e-9)
    _, slope = filter_benchmark.gradient(std, ours)
    for k in range(5):
        step = jnp.zeros(5).at[k].set(1e-5)
        high, low = (filter_benchmark.gradient(std + sign * step, ours)[0] for sign in (1.0, -1.0))
        np.testing.assert_allclose(slope[k], (high - low) / 2e-5, rtol=1e-5, atol=1e-9)


@pytest.mark.slow
def test_two_devices_filter_as_one_does_and_do_not_hang(tmp_path, monkeypatch):
    monkeypatch.setattr(filter_benchmark, "TIMEOUT", 120.0)
    ends = []
    for count in (1, 2):
        arguments = {"seed": 0, "num_trials": 4, "repeats": 1, "pinned": False}
        done = filter_benchmark.run_task("devices", str(tmp_path), arguments, num_devices=count)
        assert done.get("devices") == count, done
        ends.append(done["ends"])
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-5)


def test_a_task_that_takes_too_long_or_fails_has_a_note(tmp_path, monkeypatch):
    done = filter_benchmark.run_task("memory", str(tmp_path), {"wrong": 1})
    assert "failed" in done["memory_note"]
    monkeypatch.setattr(filter_benchmark, "TIMEOUT", 0.01)
    done = filter_benchmark.run_task("memory", str(tmp_path), {})
    assert "longer" in done["memory_note"]


def test_peers_that_are_missing_or_broken_have_a_note(monkeypatch):
    def missing():
        raise ImportError("none")

    def broken():
        raise AttributeError("jax has no such thing")

    own = {"missing": missing, "broken": broken, "filterpy": peer_filters.PEERS["filterpy"]}
    monkeypatch.setattr(peer_filters, "PEERS", own)
    found = peer_filters.table(workload.as_floats(short(2, 2)))
    assert found["missing"] is None and found["broken"]["filter"] is None
    assert "no such thing" in found["broken"]["note"]
    assert found["filterpy"]["filter"]["batch"] == 2


@pytest.mark.slow
def test_neither_filter_nor_gradient_calls_lapack():
    config = Config(filter=FilterConfig(max_landmarks=8))
    params, beams = NoiseParams.for_simulated_robot(), (config.frontend.lidar.num_beams,)
    scan = Scan(jax.ShapeDtypeStruct(beams, float), jax.ShapeDtypeStruct(beams, bool))
    features = jax.eval_shape(partial(extract.extract_features, config.frontend), scan)
    features = jax.tree.map(lambda x: jax.ShapeDtypeStruct((3, *x.shape), x.dtype), features)
    measurements = Measurement(jax.ShapeDtypeStruct((3, 3), float), features)
    start = init(config.filter, jnp.zeros(3))

    def run(params, measurements):
        return slam_filter.run_filter(config.filter, params, start, measurements)[1].pose

    slope = jax.grad(lambda params, measurements: jnp.sum(run(params, measurements) ** 2))
    drive = workload.as_floats(short(2, 2), np.float64)
    std = jnp.array(peer_filters.STD)
    calls = [(run, params, measurements), (slope, params, measurements)]
    calls += [(filter_benchmark.filter_drive, drive), (filter_benchmark.gradient, std, drive)]
    for call, *arguments in calls:
        traced = jax.jit(call).trace(*arguments)
        assert not re.search(LAPACK, str(traced.jaxpr) + traced.lower().as_text())


@pytest.mark.parametrize("name", ["cholesky", "eigh", "svd", "inv", "qr"])
def test_a_call_of_lapack_would_be_found(name):
    traced = jax.jit(getattr(jnp.linalg, name)).trace(jnp.eye(2))
    assert re.search(LAPACK, str(traced.jaxpr)) and "lapack" in traced.lower().as_text()


def test_a_start_is_timed_until_the_bar_says_that_scans_are_mapped(tmp_path):
    wait = "import sys, time; time.sleep(0.3); "
    code = f"{wait}print('mapping', file=sys.stderr, flush=True); {wait}"
    taken = start.start(tmp_path / "log", tmp_path, code)
    assert 0.3 <= taken["mapped_s"] <= taken["written_s"] - 0.3
    for bad in (f"{wait}raise SystemExit('no log')", "print('nothing')"):
        with pytest.raises(SystemExit, match="log: .*"):
            start.start(tmp_path / "log", tmp_path, bad)
    kinds = {kind: taken for kind in ("first", "later", "traced_anew")}
    start.draw({"log": "log", "starts": kinds}, tmp_path / "start.png")
    assert (tmp_path / "start.png").stat().st_size > 1000


def test_the_log_that_is_started_with_is_the_office_drive(tmp_path):
    start.simulate_log(0, tmp_path / "office.npz")
    log = readers.read_log(tmp_path / "office.npz")
    steps = common.drive_in()[3]
    assert log.ranges.shape == (steps, Config().frontend.lidar.num_beams)
    assert np.isfinite(log.ranges).mean() > 0.9 and log.num_skipped == 0
    assert 70.0 < np.hypot(*np.diff(log.odom_poses[:, :2], axis=0).T).sum() < 90.0


def test_drives_that_are_timed_are_compiled_as_for_long_work(monkeypatch):
    """Few are else compiled quickly, and run slower than many do."""
    seen = []

    def drive_in():
        seen.append(is_short(1))
        raise RuntimeError("enough")

    monkeypatch.setattr(common, "drive_in", drive_in)
    for measured in (benchmark.chain, life_benchmark.compute):
        with pytest.raises(RuntimeError, match="enough"):
            measured(0, 1, 1)
    assert seen == [False, False] and is_short(1)
