import os
import subprocess
import sys
from contextlib import nullcontext
from functools import wraps

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import se2, trace_cache
from jaxslam.core.devices import DeviceMap
from jaxslam.core.scan import Lidar
from jaxslam.frontend import lidar as lidar_module

LIDAR = Lidar(num_beams=3)
RANGES = jnp.array([1.0, 20.0, 0.3])
SCAN = lidar_module.to_scan(LIDAR, RANGES)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Folder of the cache, which is on."""
    before, path = trace_cache.setting("jax_compilation_cache_dir"), tmp_path / "cache"
    monkeypatch.setattr(trace_cache, "_enabled", True)
    jax.config.update("jax_compilation_cache_dir", str(path))
    yield path
    jax.config.update("jax_compilation_cache_dir", before)


def to_scan(function=lidar_module.to_scan):
    """A function of the package that returns a record, jitted as by another process."""
    return trace_cache.jit(function, static_argnames="lidar")


def untraceable():
    """`to_scan`, which must not be traced."""

    @wraps(lidar_module.to_scan)
    def traced(lidar, ranges):
        raise RuntimeError("traced")

    return to_scan(traced)


def files(path):
    return sorted(path.glob("jaxslam-*"))


def assert_same(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    jax.tree.map(np.testing.assert_array_equal, one, two)


def test_what_was_traced_once_is_not_traced_again(folder):
    first = to_scan()(LIDAR, RANGES)
    assert_same(first, SCAN)
    assert len(files(folder)) == 1 and not list(folder.glob(".unfinished*"))
    again = untraceable()
    for given in (RANGES, np.asarray(RANGES), jnp.asarray(first.ranges).at[1].set(20.0)):
        assert_same(again(LIDAR, ranges=given), first)


def test_calls_use_what_was_compiled_ahead_of_time(folder, caplog):
    jitted = to_scan()
    traced = jitted.trace(LIDAR, jax.ShapeDtypeStruct(RANGES.shape, RANGES.dtype))
    traced.lower().compile()
    assert traced.out_info.ranges.shape == (3,)
    with jax.log_compiles():
        jitted(LIDAR, np.asarray(RANGES))
    assert "Compiling" not in caplog.text


@pytest.mark.parametrize("what", ["sources", "setting", "precision", "static", "shape", "type"])
def test_a_changed_key_is_traced_anew(folder, monkeypatch, what):
    to_scan()(LIDAR, RANGES)
    lidar = LIDAR._replace(range_max=9.0) if what == "static" else LIDAR
    ranges = {"shape": RANGES[None], "type": np.float32(RANGES)}.get(what, RANGES)
    if what == "sources":
        monkeypatch.setattr(trace_cache, "version", lambda: "others")
    setting = {
        "setting": lambda: jax.default_matmul_precision("highest"),
        "precision": lambda: jax.enable_x64(False),
    }.get(what, nullcontext)
    with setting(), pytest.raises(RuntimeError, match="traced"):
        untraceable()(lidar, ranges)


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-9], lambda data: b"", lambda data: data[::-1]]
)
def test_a_damaged_file_is_written_again(folder, damage):
    to_scan()(LIDAR, RANGES)
    (file,) = files(folder)
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    assert_same(to_scan()(LIDAR, RANGES), SCAN)
    assert files(folder) == [file]
    assert_same(untraceable()(LIDAR, RANGES), SCAN)


def test_a_folder_that_cannot_be_written_is_ignored(folder):
    folder.write_text("a file")
    assert_same(to_scan()(LIDAR, RANGES), SCAN)
    assert folder.read_text() == "a file"


def test_nothing_is_kept_unless_enabled(folder, monkeypatch):
    monkeypatch.setattr(trace_cache, "_enabled", False)
    to_scan()(LIDAR, RANGES)
    assert not files(folder)


def test_functions_without_a_stable_name_are_not_kept(folder):
    double = trace_cache.jit(lambda x: 2 * x)
    assert double(RANGES).tolist() == (2 * RANGES).tolist()
    device_map = DeviceMap(lambda common, item: common * item, size=2)
    assert device_map(jnp.float64(2.0), jnp.arange(3.0)).tolist() == [0.0, 2.0, 4.0]
    assert not files(folder)


def test_within_other_programs_it_is_plain_jit(folder):
    jitted = trace_cache.jit(se2.compose)
    both = jnp.stack([RANGES, 2 * RANGES])
    assert_same(jax.vmap(jitted)(both, both), jax.vmap(se2.compose)(both, both))
    slopes = [jax.jacobian(function)(RANGES, RANGES) for function in (jitted, se2.compose)]
    assert_same(*slopes)
    assert not files(folder)
    with jax.disable_jit():
        jitted(RANGES, RANGES)
    assert not files(folder)


def test_results_are_on_the_device_of_the_arguments(folder):
    for device in jax.devices()[:2]:
        given = jax.device_put(RANGES, device)
        assert to_scan()(LIDAR, given).ranges.devices() == {device}
    assert len(files(folder)) == 1


def test_results_of_kept_programs_are_the_same_bit_for_bit(folder, monkeypatch):
    device_map = DeviceMap(se2.compose, size=4)
    items = jnp.linspace(0.0, 1.0, 57).reshape(19, 3)
    kept = device_map(RANGES, items)
    assert len(files(folder)) == 1
    monkeypatch.setattr(trace_cache, "_enabled", False)
    assert_same(kept, device_map(RANGES, items))


CODE = """
import jax, jax.numpy as jnp
from jaxslam.core import trace_cache
from jaxslam.core.scan import Lidar
from jaxslam.frontend.lidar import to_scan
traced = []
def listen(event, duration, **about):
    if event.endswith("jaxpr_trace_duration"):
        traced.append(about["fun_name"])
jax.monitoring.register_event_duration_secs_listener(listen)
trace_cache.enable()
scan = trace_cache.jit(to_scan, static_argnames="lidar")(Lidar(num_beams=3), jnp.ones(3))
print(len(traced), sum(float(x.sum()) for x in jax.tree.leaves(scan)))
"""


@pytest.mark.timeout(120)
def test_another_process_does_not_trace_again(tmp_path):
    def output(seed):
        own = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "PYTHONHASHSEED": str(seed)}
        command = [sys.executable, "-c", CODE]
        done = subprocess.run(
            command, env=os.environ | own, capture_output=True, text=True, check=True
        )
        return done.stdout.split()

    (many, first), (few, second) = output(1), output(2)
    assert first == second and int(few) < int(many)
    assert len(files(tmp_path)) == 1


def test_the_version_depends_on_the_sources_of_all_packages(tmp_path, monkeypatch):
    assert (trace_cache.HOME / "frontend" / "extract.py").is_file()
    digests = []
    for text in ("a = 1", "a = 2"):
        (tmp_path / "frontend").mkdir(exist_ok=True)
        (tmp_path / "frontend" / "extract.py").write_text(text)
        monkeypatch.setattr(trace_cache, "HOME", tmp_path)
        digests.append(trace_cache.version.__wrapped__())
    assert digests[0] != digests[1]
