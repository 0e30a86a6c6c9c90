import gc
import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

import jaxslam
from jaxslam.core import caches, trace_cache
from jaxslam.core.cache_limit import UNFINISHED, cache_files, limit_size
from jaxslam.core.scan import Lidar
from jaxslam.frontend.lidar import to_scan

NOW = time.time()
HOUR = 3600.0


def digest(number):
    return f"{number:064x}"


def traced(number):
    return f"jaxslam-run_filter-{digest(number)}"


def compiled(number):
    return f"jit_run-{digest(number)}-cache"


def write(path, *, size=100, hours_ago=1.0):
    """A file that was used so long ago."""
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(bytes(size))
    os.utime(path, (NOW - HOUR * hours_ago,) * 2)
    return path


def names(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("seed", range(5))
def test_those_that_were_used_last_stay_as_far_as_the_limit_goes(tmp_path, seed):
    rng = np.random.default_rng(seed)
    sizes, ages = rng.integers(1, 100, 30), rng.permutation(30) + 1.0
    of_number = [(traced, compiled)[k % 2](k) for k in range(30)]
    for name, size, age in zip(of_number, sizes, ages, strict=True):
        write(tmp_path / name, size=int(size), hours_ago=age)
    limit = int(rng.integers(0, sizes.sum() + 1))
    limit_size(tmp_path, limit, compiled=True)
    newest_first = np.argsort(ages)
    count = np.searchsorted(np.cumsum(sizes[newest_first]), limit, side="right")
    assert names(tmp_path) == {of_number[k] for k in newest_first[:count]}


def test_reading_or_writing_is_use(tmp_path):
    read, written, neither = (write(tmp_path / traced(k), hours_ago=9) for k in range(3))
    os.utime(read, (NOW - HOUR, NOW - 9 * HOUR))  # time of access, time of modification
    os.utime(written, (NOW - 9 * HOUR, NOW - HOUR))
    limit_size(tmp_path, 200, compiled=True)
    assert read.exists() and written.exists() and not neither.exists()


OTHERS = [
    "notes.txt",
    "jaxslam",
    "jaxslam-run_filter",
    f"jaxslam-run_filter-{digest(1)}.npz",
    f"jaxslam-run_filter-{digest(1)[1:]}",
    f"other-run_filter-{digest(1)}",
    f"{digest(1)}-cache",
    "pip-cache",
    f"jit_run-{digest(9)}-cache.bak",
    f"jit_run-{digest(9)}-atime",
    ".lockfile",
    f"{UNFINISHED}abc/notes.txt",
    f"folder/jaxslam-run_filter-{digest(1)}",
]


def test_other_files_and_links_stay_and_do_not_count(tmp_path):
    folder, outside = tmp_path / "cache", tmp_path / "outside"
    for name in OTHERS:
        write(folder / name, size=1000, hours_ago=99)
    write(outside / traced(5))
    (folder / traced(2)).symlink_to(outside / traced(5))
    (folder / traced(3)).symlink_to(tmp_path / "nothing")
    (folder / traced(4)).mkdir()
    (folder / f"{UNFINISHED}link").symlink_to(outside)
    own = write(folder / traced(6), size=100)
    limit_size(folder, 100, compiled=True)
    assert own.exists()
    limit_size(folder, 0, compiled=True)
    assert not own.exists()
    assert names(folder) >= set(OTHERS) and (outside / traced(5)).exists()
    assert (folder / traced(2)).is_symlink() and (folder / traced(3)).is_symlink()
    assert (folder / traced(4)).is_dir()


def test_compiled_programs_are_left_to_jax_where_it_is_asked_for(tmp_path):
    write(tmp_path / compiled(1), hours_ago=9)
    write(tmp_path / traced(2), hours_ago=3)
    write(tmp_path / traced(3), hours_ago=2)
    limit_size(tmp_path, 100, compiled=False)
    assert names(tmp_path) == {compiled(1), traced(3)}


def test_the_time_that_jax_notes_goes_with_its_program(tmp_path):
    for k in (1, 2):
        write(tmp_path / compiled(k), hours_ago=k)
        write(tmp_path / compiled(k).replace("-cache", "-atime"), size=8)
    limit_size(tmp_path, 100, compiled=True)
    assert names(tmp_path) == {compiled(1), compiled(1).replace("-cache", "-atime")}


def test_what_a_process_left_unfinished_goes_with_its_folder(tmp_path):
    write(tmp_path / f"{UNFINISHED}abc" / traced(1), hours_ago=9)
    write(tmp_path / traced(2))
    limit_size(tmp_path, 100, compiled=True)
    assert [path.name for path in tmp_path.iterdir()] == [traced(2)]


def test_times_far_ahead_of_the_clock_are_not_taken_for_recent_use(tmp_path):
    ahead = write(tmp_path / traced(1), hours_ago=-24 * 365)
    a_little = write(tmp_path / traced(2), hours_ago=-1)
    old = write(tmp_path / traced(3), hours_ago=9)
    limit_size(tmp_path, 200, compiled=True)
    assert not ahead.exists() and a_little.exists() and old.exists()


def test_with_a_clock_that_was_set_back_the_order_is_still_that_of_use(tmp_path, monkeypatch):
    """As on a robot without a battery for its clock, which starts in 1970."""
    files = [write(tmp_path / traced(k), hours_ago=k) for k in range(1, 4)]
    now = write(tmp_path / traced(9))
    os.utime(now, (60.0, 60.0))
    monkeypatch.setattr(time, "time", lambda: 90.0)
    limit_size(tmp_path, 200, compiled=True)
    assert [file.exists() for file in (*files, now)] == [True, False, False, True]


def test_what_cannot_be_removed_stays_and_nothing_goes_in_its_place(tmp_path, monkeypatch):
    old, new = write(tmp_path / traced(1), hours_ago=9), write(tmp_path / traced(2))
    remove = Path.unlink

    def refuse(self, *arguments):
        if self == old:
            raise PermissionError(str(self))
        remove(self, *arguments)

    monkeypatch.setattr(Path, "unlink", refuse)
    limit_size(tmp_path, 100, compiled=True)
    assert old.exists() and new.exists()


def test_a_folder_that_is_missing_or_cannot_be_read_is_left_alone(tmp_path, monkeypatch):
    limit_size(tmp_path / "none", 0, compiled=True)
    limit_size(write(tmp_path / "file"), 0, compiled=True)

    def refuse(path):
        raise PermissionError(path)

    monkeypatch.setattr(os, "scandir", refuse)
    assert not list(cache_files(tmp_path, compiled=True))


CODE = """
import sys, time
from pathlib import Path
from jaxslam.core.cache_limit import limit_size
assert "jax" not in sys.modules
until = time.time() + 1.0
while time.time() < until:
    limit_size(Path(sys.argv[1]), 2000, compiled=True)
"""


@pytest.mark.timeout(60)
def test_processes_that_do_it_at_once_remove_no_more_than_one_does(tmp_path):
    command = [sys.executable, "-W", "error", "-c", CODE, str(tmp_path)]
    home = str(Path(next(iter(jaxslam.__path__))).parent)
    own = os.environ | {"PYTHONPATH": home}
    running = [subprocess.Popen(command, env=own) for _ in range(2)]
    number = 0
    while any(process.poll() is None for process in running):
        number += 1
        new = write(tmp_path / "new", hours_ago=-number / HOUR)
        new.replace(tmp_path / (traced, compiled)[number % 2](number))
        time.sleep(0.002)
    assert [process.returncode for process in running] == [0, 0]
    limit_size(tmp_path, 2000, compiled=True)
    last = range(number - 19, number + 1)
    assert number > 40 and names(tmp_path) == {(traced, compiled)[k % 2](k) for k in last}


@pytest.fixture
def enabled(tmp_path, monkeypatch):
    """The cache is off and without a folder; nothing that a test changes outlives it."""
    options = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before, threshold = [trace_cache.setting(name) for name in options], gc.get_threshold()
    monkeypatch.setattr(trace_cache, "_enabled", False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    yield tmp_path / "home" / "jaxslam"
    for name, value in zip(options, before, strict=True):
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    gc.set_threshold(*threshold)
    gc.unfreeze()


def fill(folder):
    folder.mkdir(parents=True, exist_ok=True)
    write(folder / traced(1), hours_ago=9)
    write(folder / compiled(2), hours_ago=8)
    write(folder / traced(3), hours_ago=7)
    write(folder / "mine")


@pytest.mark.parametrize("given", [False, True])
def test_enabling_removes_what_is_above_the_limit(enabled, tmp_path, given):
    folder = tmp_path / "given" if given else enabled
    fill(folder)
    caches.enable_caches(*([folder] if given else []), max_bytes=100)
    assert names(folder) == {traced(3), "mine"}


def test_a_folder_that_the_user_has_given_jax_keeps_what_jax_has_compiled(enabled, tmp_path):
    fill(tmp_path / "own")
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "own"))
    caches.enable_caches(max_bytes=0)
    assert names(tmp_path / "own") == {compiled(2), "mine"}


def test_a_limit_that_jax_keeps_is_left_to_jax(enabled):
    fill(enabled)
    jax.config.update("jax_compilation_cache_max_size", 10**9)
    try:
        caches.enable_caches(max_bytes=0)
    finally:
        jax.config.update("jax_compilation_cache_max_size", -1)
    assert names(enabled) == {compiled(2), "mine"}


@pytest.mark.parametrize("limit", [{}, {"max_bytes": None}])
def test_a_small_folder_stays_as_it_is(enabled, limit):
    fill(enabled)
    caches.enable_caches(**limit)
    assert len(names(enabled)) == 4
    assert caches.MAX_BYTES == 1024**3


@pytest.mark.parametrize("wrong", [-1, 1.5, "2 GB", True])
def test_a_limit_that_is_no_size_is_refused(enabled, wrong):
    with pytest.raises(ValueError, match="max_bytes is .*, not a whole number of at least 0"):
        caches.enable_caches(max_bytes=wrong)
    assert not trace_cache._enabled


def call_kept(folder):
    """A function of the package, jitted as by another process, with the cache in a folder."""
    trace_cache.enable()
    jax.config.update("jax_compilation_cache_dir", str(folder))
    kept = trace_cache.jit(to_scan, static_argnames="lidar")
    return kept(Lidar(num_beams=3), jnp.array([1.0, 20.0, 0.3]))


def test_a_program_that_is_loaded_counts_as_used(enabled):
    call_kept(enabled)
    (file,) = enabled.glob("jaxslam-*")
    os.utime(file, (NOW - 99 * HOUR,) * 2)
    write(enabled / traced(1), hours_ago=9)
    call_kept(enabled)
    assert file.stat().st_mtime > NOW - HOUR  # which reading alone does not change
    limit_size(enabled, file.stat().st_size, compiled=True)
    assert file.exists() and not (enabled / traced(1)).exists()


def test_names_of_both_caches_are_those_that_are_written(enabled):
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    call_kept(enabled)
    both, own = (list(cache_files(enabled, compiled=kind)) for kind in (True, False))
    assert len(own) == 1 and len(both) > 1
    assert {file.path.name for file in both} == names(enabled)


def test_a_folder_that_cannot_be_written_is_read_and_nothing_is_raised(enabled, monkeypatch):
    first = call_kept(enabled)
    before = names(enabled)

    def refuse(*arguments, **options):
        raise PermissionError("read-only")

    monkeypatch.setattr(os, "utime", refuse)
    monkeypatch.setattr(Path, "unlink", refuse)
    monkeypatch.setattr(trace_cache, "TemporaryDirectory", refuse)
    again = call_kept(enabled)
    caches.enable_caches(max_bytes=0)
    assert names(enabled) == before
    jax.tree.map(np.testing.assert_array_equal, first, again)
