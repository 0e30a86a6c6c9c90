"""Starts of builds that are written here: they work longer while their cache folder is empty."""

import json
import os
import time
import zipfile
from pathlib import Path

import pytest

from experiments import cold_start
from jaxslam.io.errors import InputError

MAIN = """
import os, pathlib, sys, time

def main():
    cache = pathlib.Path(os.environ["XDG_CACHE_HOME"])
    if "bad" in sys.argv:
        print("first line", file=sys.stderr)
        raise SystemExit("no such thing")
    if "slow" in sys.argv:
        pathlib.Path("pid").write_text(str(os.getpid()))
        time.sleep(20.0)
    if not cache.exists():
        cache.mkdir()
        memory = b"1" * (SIZE << 20)
        while time.process_time() < SECONDS:
            pass
    out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
    (out / "done").write_text(str(sys.argv[1:]))
"""
FILES = {"jaxslam/__init__.py": "", "jaxslam/cli/__init__.py": ""}


def files(size=0, seconds=0.0):
    main = MAIN.replace("SIZE", str(size)).replace("SECONDS", str(seconds))
    return FILES | {"jaxslam/cli/main.py": main}


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    return not stat.is_file() or stat.read_text().rpartition(") ")[2][0] != "Z"


def checkout(folder, **costs):
    for name, text in files(**costs).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def wheel(folder):
    about = "jaxslam-9.0.dist-info"
    extra = {
        f"{about}/METADATA": "Metadata-Version: 2.1\nName: jaxslam\nVersion: 9.0\n",
        f"{about}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    names = files() | extra
    record = "".join(f"{name},,\n" for name in [*names, f"{about}/RECORD"])
    path = folder / "jaxslam-9.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as file:
        for name, text in (names | {f"{about}/RECORD": record}).items():
            file.writestr(name, text)
    return path


@pytest.fixture
def this(tmp_path, monkeypatch):
    build = cold_start.Build("this", checkout(tmp_path / "own", size=100, seconds=0.5))
    monkeypatch.setattr(cold_start, "this_build", lambda: build)
    monkeypatch.setattr(cold_start, "COMMANDS", {"tune": ("tune", "-n"), "run": ("run", "LOG")})
    return build


def test_a_start_is_cold_once_and_has_its_own_time_and_memory(this, tmp_path):
    out = tmp_path / "out"
    cold, warm = (
        cold_start.start_once(this, ("run", "log"), tmp_path / "cache", out) for _ in range(2)
    )
    assert (out / "done").read_text() == str(["run", "log", "--out", str(out)])
    assert cold["cpu_s"] >= 0.5 and cold["wall_s"] >= 0.4
    # The process that runs this test holds more than all of it.
    assert 100.0 < cold["peak_mb"] < 150.0 and 1.0 < warm["peak_mb"] < 50.0


def test_commands_that_fail_or_take_too_long_have_a_note(this, tmp_path, monkeypatch):
    done = cold_start.start_once(this, ("bad",), tmp_path / "cache", tmp_path / "out")
    assert done == {"note": "it failed: no such thing"}
    monkeypatch.setattr(cold_start, "TIMEOUT", 2.0)
    done = cold_start.start_once(this, ("slow",), tmp_path / "cache", tmp_path / "out")
    assert "longer" in done["note"]
    pid = int((tmp_path / "out" / "pid").read_text())
    for _ in range(100):  # until the system has removed it
        if not alive(pid):
            break
        time.sleep(0.05)
    assert not alive(pid) and not (tmp_path / "out" / "done").exists()


def test_all_numbers_of_two_builds(this, tmp_path, capsys):
    log = tmp_path / "drive.log"
    log.write_text("scans")
    other = checkout(tmp_path / "other")
    out = tmp_path / "results"
    arguments = ["--out", str(out), "--log", str(log), "--against", str(other), "--repeats", "2"]
    assert cold_start.main(arguments) == 0
    numbers = json.loads((out / "cold_start.json").read_text())
    builds = numbers["cold_start"]["builds"]
    assert list(builds) == ["this", "other"] and numbers["cold_start"]["log"] == "drive.log"
    for command in ("tune", "run"):
        own, theirs = (builds[name][command] for name in builds)
        assert numbers["cold_first_result"][command] == own["cold"]["wall_s"]
        for kind in cold_start.KINDS:
            assert numbers["cpu_seconds"][command][kind] == own[kind]["cpu_s"]
            ratio = numbers["ratio_to"]["cpu_seconds"][command][kind]
            assert ratio == pytest.approx(own[kind]["cpu_s"] / theirs[kind]["cpu_s"])
        assert own["cold"]["peak_mb"] > 100.0 > own["warm"]["peak_mb"]
        assert 100.0 > theirs["cold"]["peak_mb"]
        assert numbers["ratio_to"]["peak_mb"][command]["cold"] > 2.0
        assert numbers["ratio_to"]["cold_first_result"][command] > 0.0
    assert numbers["ratio_to"]["build"] == "other"
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith(("tune, ", "run, ")) for line in lines) == 8
    assert (out / "cold_start.png").stat().st_size > 1000


def test_without_another_build_there_is_no_ratio_and_a_failure_is_null(this, tmp_path, monkeypatch):
    monkeypatch.setattr(cold_start, "COMMANDS", {"tune": ("bad",), "run": ("run", "LOG")})
    numbers = cold_start.compute(0, str(tmp_path), "", 1)
    assert numbers["ratio_to"] is None and numbers["cold_first_result"]["tune"] is None
    assert numbers["cpu_seconds"]["tune"] == {"cold": None, "warm": None}
    assert numbers["cold_first_result"]["run"] > 0.0
    starts = numbers["cold_start"]["builds"]["this"]
    itself = cold_start.ratios(starts, starts, "this")
    assert itself["cold_first_result"] == {"tune": None, "run": 1.0}
    assert itself["cpu_seconds"]["run"] == itself["peak_mb"]["run"] == {"cold": 1.0, "warm": 1.0}
    cold_start.print_table(numbers | {"ratio_to": itself})
    cold_start.save_picture(numbers, tmp_path / "starts.png")


def test_a_wheel_is_installed_for_itself(tmp_path):
    pytest.importorskip("pip")
    (tmp_path / "installed").mkdir()
    path = wheel(tmp_path)
    build = cold_start.other_build(path, tmp_path / "installed")
    assert build == cold_start.Build(path.name, tmp_path / "installed")
    done = cold_start.start_once(build, ("run",), tmp_path / "cache", tmp_path / "out")
    assert "note" not in done and (tmp_path / "out" / "done").is_file()


def test_what_is_no_build_or_no_log_is_one_error(tmp_path, capsys):
    (tmp_path / "bad.whl").write_text("no wheel")
    (tmp_path / "installed").mkdir()
    for name in ("none", "none.whl", "bad.whl"):
        with pytest.raises(InputError, match=name):
            cold_start.other_build(tmp_path / name, tmp_path / "installed")
    broken = checkout(tmp_path / "broken")
    (broken / "jaxslam" / "__init__.py").write_text("raise ImportError('half a build')")
    with pytest.raises(InputError, match="half a build"):
        cold_start.other_build(broken, tmp_path / "installed")
    assert cold_start.main(["--out", str(tmp_path), "--log", str(tmp_path / "none.log")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_commands_are_those_of_the_command_line():
    readme = Path(cold_start.__file__).parents[1] / "jaxslam" / "cli" / "README.md"
    text = readme.read_text()
    assert all(f"`{words[0]}" in text for words in cold_start.COMMANDS.values())
