"""One piece of work by several processes, on this machine or on many, joined by `jax.distributed`.

JAX ends a process that has lost another by an abort. So each runs below one that uses no JAX, which
tells what happened in one line, and leaves no process behind.
"""

import os
import shutil
import signal
import socket
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Sequence
from multiprocessing import connection, get_context, parent_process
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

import jax

from jaxslam.core.devices import num_cores, use_cpu_devices
from jaxslam.io.errors import InputError

WAIT = 45.0  # [s] in which all processes must have come up
HEARTBEAT = 20  # [s] without a sign of life after which a process is lost
LOOPBACK = "127.0.0.1"


class Group(NamedTuple):
    """Processes that work together, and which of them are started here."""

    address: str  # HOST:PORT at which process 0 coordinates them
    count: int
    own: Sequence[int]  # numbers of those started here


class Lost(RuntimeError):
    """A process did not come up, or ended early."""


def local(count: int) -> Group:
    """Processes of this machine alone, which others cannot reach."""
    with socket.socket() as free:
        free.bind((LOOPBACK, 0))
        return Group(f"{LOOPBACK}:{free.getsockname()[1]}", count, range(count))


def run(group: Group, work: Callable, *given: Any) -> list[Any]:
    """Call `work(*given, say=...)` in every process; return what it returned in those of here.

    Args:
        group: The processes.
        work: A function of a module. It may write to the stream `say`; whatever else is printed
            goes to a file.
        given: Its arguments.

    Raises:
        Lost: One of them did not come up, or has ended early; the others are ended too.
        InputError: The work has refused its input.
    """
    spawn = get_context("spawn")
    cores = max(1, num_cores() // len(group.own))
    logs = Path(tempfile.mkdtemp(prefix="processes-"))
    children, results = {}, {}
    # Ctrl-C reaches all processes of a terminal, and is for this one.
    kept = _ignore_interrupts()
    try:
        for number in group.own:
            here, there = spawn.Pipe(duplex=False)
            log = logs / f"{number}.txt"
            arguments = (work, given, group, number, cores, WAIT, there, log)
            child = spawn.Process(target=_child, args=arguments)
            child.start()
            there.close()
            children[number] = (child, here)
    finally:
        _restore_interrupts(kept)
    told = False  # where the logs are
    try:
        _follow(group, children, results, monotonic() + WAIT, logs)
    except Lost as error:
        told = str(logs) in str(error)
        raise
    finally:
        for child, _ in children.values():
            child.kill()
            child.join()
        if not told:
            shutil.rmtree(logs, ignore_errors=True)
    return [results[number] for number in group.own]


def _follow(group: Group, children: dict, results: dict, deadline: float, logs: Path) -> None:
    """Collect results of the children until all are there, or one is lost."""
    up = set()
    while open_ := {k: c for k, c in children.items() if k not in results}:
        left = None if len(up) == len(children) else max(0.0, deadline - monotonic())
        waited = [x for child, pipe in open_.values() for x in (child.sentinel, pipe)]
        if not connection.wait(waited, left):
            raise _missing(group)
        ended = []
        for number, (child, pipe) in open_.items():
            gone = not child.is_alive()  # what it has said before counts
            for what, value in _heard(pipe):
                if what == "up":
                    up.add(number)
                elif what == "done":
                    results[number] = value
                elif what == "refused":
                    raise InputError(value)
                else:
                    ended.append((number, value))
            if gone and number not in results:
                child.join()
                ended.append((number, child.exitcode))
        if ended:
            raise _early(group, ended, up, logs)


def _early(group: Group, ended: list, up: set[int], logs: Path) -> Lost:
    """What to say of processes that ended early, each with its error or exit code."""
    # An abort is how JAX ends those that have lost another, or have found none.
    number, why = min(ended, key=lambda one: (one[1] == -signal.SIGABRT, isinstance(one[1], int)))
    if why == -signal.SIGABRT:
        if number not in up:
            return _missing(group)
        why = "it has lost another one"
    why = f"exit code {why}" if isinstance(why, int) else why
    return Lost(f"process {number} of {group.count} ended early ({why}); see {logs}")


def _missing(group: Group) -> Lost:
    return Lost(f"not all of {group.count} processes came up at {group.address}; start every one")


def _heard(pipe: connection.Connection) -> list[tuple[str, Any]]:
    """What a process has said since."""
    heard = []
    try:
        while pipe.poll():
            heard.append(pipe.recv())
    except (EOFError, OSError):
        pass
    return heard


def _child(
    work: Callable,
    given: tuple,
    group: Group,
    number: int,
    cores: int,
    wait: float,
    pipe: connection.Connection,
    log: Path,
) -> None:
    """One process: join the others, work, tell the parent."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    say = os.fdopen(os.dup(2), "w") if number == min(group.own) else open(os.devnull, "w")
    into = os.open(log, os.O_WRONLY | os.O_CREAT)
    for stream in (1, 2):
        os.dup2(into, stream)
    try:
        use_cpu_devices(cores)
        bind = group.address if group.address.startswith(LOOPBACK) else None
        jax.distributed.initialize(
            group.address,
            group.count,
            number,
            cluster_detection_method="deactivate",
            initialization_timeout=int(wait) + 1,
            heartbeat_timeout_seconds=HEARTBEAT,
            coordinator_bind_address=bind,
        )
        jax.devices()
        pipe.send(("up", None))
        result = work(*given, say=say)
        jax.distributed.shutdown()
        say.close()
        pipe.send(("done", result))
    except InputError as error:
        _leave(pipe, ("refused", str(error)))
    except BaseException as error:
        traceback.print_exc()
        lines = str(error).splitlines() or [""]
        _leave(pipe, ("failed", f"{type(error).__name__}: {lines[0][:200]}"))


def _leave(pipe: connection.Connection, message: tuple[str, str]) -> None:
    """End at once: JAX would first wait for the others."""
    pipe.send(message)
    sys.stderr.flush()
    os._exit(1)


def _end_with_parent() -> None:
    connection.wait([parent_process().sentinel])
    os._exit(1)


def _ignore_interrupts() -> Any:
    """Ignore Ctrl-C, where that is possible; returns what did not."""
    if threading.current_thread() is not threading.main_thread():
        return None
    return signal.signal(signal.SIGINT, signal.SIG_IGN)


def _restore_interrupts(kept: Any) -> None:
    if kept is not None:
        signal.signal(signal.SIGINT, kept)
