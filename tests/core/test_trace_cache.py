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
from jaxslam.filtering import config as config_module
from jaxslam.filtering.config import FilterConfig
from jaxslam.pipeline.config import Config

CONFIG = Config(
    filter=FilterConfig(
        max_landmarks=5,
    ),
)
POSE = jnp.array([1.0, 2.0, 0.3])


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Folder that programs are kept in."""
    before, folder = jax.config.jax_compilation_cache_dir, tmp_path / "cache"
    monkeypatch.setattr(trace_cache, "_enabled", True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    yield folder
    jax.config.update("jax_compilation_cache_dir", before)


def init(function=config_module.init):
    """A function that gives records, jitted as by another process."""
    return trace_cache.jit(function, static_argnames="config")


def known():
    """`init`, which must not be traced."""

    @wraps(config_module.init)
    def traced(config, pose, cov=None):
        raise RuntimeError("traced")

    return init(traced)


def files(folder):
    return sorted(folder.glob("jaxslam-*"))


def assert_same(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    jax.tree.map(np.testing.assert_array_equal, one, two)


def test_what_was_traced_once_is_not_traced_again(kept):
    first = init()(CONFIG, POSE)
    assert_same(first, config_module.init(CONFIG.filter, POSE))
    assert len(files(kept)) == 1 and not list(kept.glob(".unfinished*"))
    again = known()
    for given in (POSE, np.asarray(POSE), first.mean[:3]):
        assert_same(again(CONFIG, pose=given), first)


def test_what_is_compiled_beforehand_serves_calls(kept, caplog):
    jitted = init()
    traced = jitted.trace(CONFIG, jax.ShapeDtypeStruct(POSE.shape, POSE.dtype))
    traced.lower().compile()
    assert traced.out_info.mean.shape == (13,)
    with jax.log_compiles():
        jitted(CONFIG, np.asarray(POSE))
    assert "Compiling" not in caplog.text


@pytest.mark.parametrize("what", ["sources", "setting", "precision", "static", "shape", "type"])
def test_something_else_is_traced_anew(kept, monkeypatch, what):
    init()(CONFIG, POSE)
    config = (
        CONFIG._replace(
            filter=CONFIG.filter._replace(
                max_landmarks=6,
            ),
        )
        if what == "static"
        else CONFIG
    )
    pose = {"shape": POSE[:2], "type": np.float32(POSE)}.get(what, POSE)
    if what == "sources":
        monkeypatch.setattr(trace_cache, "version", lambda: "others")
    setting = {
        "setting": lambda: jax.default_matmul_precision("highest"),
        "precision": lambda: jax.enable_x64(False),
    }.get(what, nullcontext)
    with setting(), pytest.raises(RuntimeError, match="traced"):
        known()(config, pose)


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-9], lambda data: b"", lambda data: data[::-1]]
)
def test_a_damaged_file_is_written_anew(kept, damage):
    init()(CONFIG, POSE)
    (file,) = files(kept)
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    assert_same(init()(CONFIG, POSE), config_module.init(CONFIG.filter, POSE))
    assert files(kept) == [file]
    assert_same(known()(CONFIG, POSE), config_module.init(CONFIG.filter, POSE))


def test_where_nothing_can_be_written_nothing_is_kept(kept):
    kept.write_text("a file")
    assert_same(init()(CONFIG, POSE), config_module.init(CONFIG.filter, POSE))
    assert kept.read_text() == "a file"


def test_nothing_is_kept_unless_asked_for(kept, monkeypatch):
    monkeypatch.setattr(trace_cache, "_enabled", False)
    init()(CONFIG, POSE)
    assert not files(kept)


def test_what_has_no_lasting_name_is_not_kept(kept):
    act = trace_cache.jit(lambda x: 2 * x)
    assert act(POSE).tolist() == (2 * POSE).tolist()
    spread = DeviceMap(lambda common, item: common * item, size=2)
    assert spread(jnp.float64(2.0), jnp.arange(3.0)).tolist() == [0.0, 2.0, 4.0]
    assert not files(kept)


def test_within_other_programs_it_is_as_jitted_by_jax(kept):
    jitted = trace_cache.jit(se2.compose)
    both = jnp.stack([POSE, 2 * POSE])
    assert_same(jax.vmap(jitted)(both, both), jax.vmap(se2.compose)(both, both))
    slope = lambda function: jax.jacobian(function)(POSE, POSE)
    assert_same(slope(jitted), slope(se2.compose))
    assert not files(kept)
    with jax.disable_jit():
        jitted(POSE, POSE)
    assert not files(kept)


def test_results_are_on_the_device_of_the_arguments(kept):
    for device in jax.devices()[:2]:
        given = jax.device_put(POSE, device)
        assert init()(CONFIG, given).mean.devices() == {device}
    assert len(files(kept)) == 1


def test_bits_of_many_are_those_of_programs_not_kept(kept, monkeypatch):
    spread = DeviceMap(se2.compose, size=4)
    items = jnp.linspace(0.0, 1.0, 57).reshape(19, 3)
    ours = spread(POSE, items)
    assert len(files(kept)) == 1
    monkeypatch.setattr(trace_cache, "_enabled", False)
    assert_same(ours, spread(POSE, items))


CODE = """
import jax, jax.numpy as jnp
from jaxslam import online, programs, slam
traced = []
def listen(event, duration, **about):
    if event.endswith("jaxpr_trace_duration"):
        traced.append(about["fun_name"])
jax.monitoring.register_event_duration_secs_listener(listen)
programs.keep()
belief = online.begin(slam.Config(landmarks=7), jnp.ones(3), aligned=True)
print(len(traced), sum(float(x.sum()) for x in jax.tree.leaves(belief)))
"""


@pytest.mark.timeout(120)
def test_another_process_does_not_trace_again(tmp_path):
    def told(seed):
        own = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "PYTHONHASHSEED": str(seed)}
        run = [sys.executable, "-c", CODE]
        out = subprocess.run(run, env=os.environ | own, capture_output=True, text=True, check=True)
        return out.stdout.split()

    (many, first), (few, second) = told(1), told(2)
    assert first == second and int(few) < int(many)
    assert len(files(tmp_path)) == 1
