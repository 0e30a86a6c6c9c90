"""Several processes that work together: what they return, and what happens when one is lost."""

import multiprocessing
import os
import re
import signal
import subprocess
import sys
import tempfile
from time import monotonic, sleep

import numpy as np
import pytest

from jaxslam.io.errors import InputError
from jaxslam.study import processes


def hello(text, stream):
    """Work that needs no compiler."""
    import jax

    stream.write(f"this is process {jax.process_index()}\n")
    return f"{text} {jax.process_index()} of {jax.process_count()}"


def die(who, how, stream):
    """Work at which process `who` ends early, and the others wait for it."""
    import jax
    from jax.experimental import multihost_utils

    if jax.process_index() == who:
        if how == "refuse":
            raise InputError("is bad", field="--this")
        if how == "raise":
            raise ValueError("nothing to\nsee")
        os.kill(os.getpid(), signal.SIGKILL)
    multihost_utils.process_allgather(np.ones(2))


def left_over(pid):
    """Processes that process `pid` has started."""
    line = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True)
    return line.stdout.split()


@pytest.mark.timeout(120)
def test_each_process_returns_what_it_found(capfd):
    assert processes.run_group(processes.local(2), hello, "I am") == ["I am 0 of 2", "I am 1 of 2"]
    assert capfd.readouterr().err == "this is process 0\n"


@pytest.mark.timeout(120)
@pytest.mark.parametrize(
    "who, how, kind, line",
    [
        (1, "kill", processes.LostProcessError, "process 1 of 2 ended early (exit code -9)"),
        (0, "kill", processes.LostProcessError, "process 0 of 2 ended early (exit code -9)"),
        (
            1,
            "raise",
            processes.LostProcessError,
            "process 1 of 2 ended early (ValueError: nothing to)",
        ),
        (0, "refuse", InputError, "--this: is bad"),
    ],
)
def test_a_process_that_ends_early_ends_all(who, how, kind, line, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    begin = monotonic()
    with pytest.raises(kind, match=re.escape(line)):
        processes.run_group(processes.local(2), die, who, how)
    assert monotonic() - begin < 60
    assert not multiprocessing.active_children()
    assert any(tmp_path.iterdir()) is (kind is processes.LostProcessError)  # what it printed


@pytest.mark.timeout(120)
@pytest.mark.slow
def test_no_process_outlives_the_one_that_started_it(tmp_path):
    code = "from jaxslam.study import processes; from tests.study import test_processes; "
    code += "processes.run_group(processes.local(2), test_processes.idle)"
    own = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen([sys.executable, "-c", code], env=own, stderr=subprocess.PIPE)
    try:
        assert parent.stderr.readline() == b"idle\n"
        started = left_over(parent.pid)
        assert len(started) >= 2
    finally:
        parent.kill()
        parent.communicate()
    end = monotonic() + 20
    while monotonic() < end and any(os.path.exists(f"/proc/{pid}/exe") for pid in started):
        sleep(0.1)
    assert not [pid for pid in started if os.path.exists(f"/proc/{pid}/exe")]


def idle(stream):
    """Work that does not end."""
    stream.write("idle\n")
    stream.flush()
    sleep(600)
