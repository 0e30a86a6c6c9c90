import gc
import os
import re

import jax
import pytest

from jaxslam.core import trace_cache
from jaxslam.core.caches import GC_THRESHOLD, enable_caches

OPTIONS = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


@pytest.fixture(autouse=True)
def restored(monkeypatch, tmp_path):
    """Nothing that the call changes outlives a test, and the user's cache folder is another one."""
    before, threshold = [trace_cache.setting(name) for name in OPTIONS], gc.get_threshold()
    monkeypatch.setattr(trace_cache, "_enabled", False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    for name, value in zip(OPTIONS, before, strict=True):
        jax.config.update(name, value)
    gc.set_threshold(*threshold)
    gc.unfreeze()


def test_programs_are_kept_in_the_users_cache_folder(tmp_path):
    enable_caches()
    folder = tmp_path / "home" / "jaxslam"
    assert folder.is_dir() and trace_cache.setting("jax_compilation_cache_dir") == str(folder)
    assert trace_cache._enabled and gc.get_threshold()[0] == GC_THRESHOLD


def test_a_given_folder_is_made_and_used(tmp_path):
    for folder in (tmp_path / "a" / "b", str(tmp_path / "c")):
        enable_caches(folder)
        assert os.path.isdir(folder)
        assert trace_cache.setting("jax_compilation_cache_dir") == str(folder)


def test_the_folder_that_jax_has_is_kept(tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "own"))
    enable_caches()
    assert trace_cache.setting("jax_compilation_cache_dir") == str(tmp_path / "own")
    assert trace_cache._enabled


def test_nothing_is_kept_where_the_users_folder_cannot_be_made(tmp_path):
    (tmp_path / "home").write_text("a file")
    enable_caches()
    assert trace_cache.setting("jax_compilation_cache_dir") is None


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("a file")
    with pytest.raises(ValueError, match=re.escape("folder is '") + ".*file/sub', not a folder"):
        enable_caches(tmp_path / "file" / "sub")
    assert not trace_cache._enabled
