"""One piece of work by several processes, on this machine or on many, joined by `jax.distributed`.

JAX ends a process that has lost another by an abort. So each is the child of one that uses no JAX,
which reports what happened in one line, and leaves no process behind.
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

STARTUP_TIMEOUT = 45.0  # [s] in which all processes must have started
HEARTBEAT = 20  # [s] without a sign of life after which a process is lost
LOOPBACK = "127.0.0.1"


class Group(NamedTuple):
    """Processes that work together, and which of them are started here.

    Attributes:
        address: HOST:PORT at which process 0 coordinates them.
        total: Number of processes.
        own: Numbers of those started here.
    """

    address: str
    total: int
    own: Sequence[int]


class LostProcessError(RuntimeError):
    """A process did not start, or ended early."""


def local(count: int) -> Group:
    """Processes of this machine alone, which others cannot reach."""
    with socket.socket() as free:
        free.bind((LOOPBACK, 0))
        return Group(f"{LOOPBACK}:{free.getsockname()[1]}", count, range(count))


def group_of(
    count: int, address: str, total: int, number: int, names: Sequence[str]
) -> Group | None:
    """The processes that some options ask for; None for this one alone.

    Args:
        count: Processes of this machine, that work together.
        address: HOST:PORT of process 0, of several machines; empty for this machine alone.
        total: Number of processes on all machines.
        number: Of the one to start here.
        names: Of the last three options, for messages.

    Raises:
        InputError: The options do not fit together.
    """
    if not address:
        if total or number >= 0:
            raise InputError("is missing", field=names[0])
        return local(count) if count > 1 else None
    if not 0 <= number < total:
        raise InputError(f"is not below {names[1]}", field=names[2])
    return Group(address, total, (number,))


def run_group(group: Group, work: Callable, *arguments: Any) -> list[Any]:
    """Call `work(*arguments, stream=...)` in every process; return the results of those of here.

    Args:
        group: The processes.
        work: A function of a module. It may write to `stream`; everything else that it prints goes
            to a log file.
        arguments: Its arguments.

    Raises:
        LostProcessError: One of them did not start, or has ended early; the others are ended too.
        InputError: The work has refused its input.
    """
    spawn = get_context("spawn")
    cores = max(1, num_cores() // len(group.own))
    logs = Path(tempfile.mkdtemp(prefix="processes-"))
    children: dict[int, tuple] = {}
    results: dict[int, Any] = {}
    # Ctrl-C reaches all processes of a terminal; only this one handles it.
    handler = _ignore_interrupts()
    try:
        for number in group.own:
            here, there = spawn.Pipe(duplex=False)
            log = logs / f"{number}.txt"
            task = (work, arguments, group, number, cores, STARTUP_TIMEOUT, there, log)
            child = spawn.Process(target=_child, args=task)
            child.start()
            there.close()
            children[number] = (child, here)
    finally:
        _restore_interrupts(handler)
    keep_logs = False
    try:
        _follow(group, children, results, monotonic() + STARTUP_TIMEOUT, logs)
    except LostProcessError as error:
        keep_logs = str(logs) in str(error)
        raise
    finally:
        for child, _ in children.values():
            child.kill()
            child.join()
        if not keep_logs:
            shutil.rmtree(logs, ignore_errors=True)
    return [results[number] for number in group.own]


def _follow(group: Group, children: dict, results: dict, deadline: float, logs: Path) -> None:
    """Collect results of the children until all are complete, or one is lost."""
    started: set[int] = set()
    while pending := {k: c for k, c in children.items() if k not in results}:
        left = None if len(started) == len(children) else max(0.0, deadline - monotonic())
        events = [x for child, pipe in pending.values() for x in (child.sentinel, pipe)]
        if not connection.wait(events, left):
            raise _missing(group)
        ended = []
        for number, (child, pipe) in pending.items():
            gone = not child.is_alive()  # messages that it sent before count
            for kind, value in _messages(pipe):
                if kind == "started":
                    started.add(number)
                elif kind == "done":
                    results[number] = value
                elif kind == "refused":
                    raise InputError(value)
                else:
                    ended.append((number, value))
            if gone and number not in results:
                child.join()
                ended.append((number, child.exitcode))
        if ended:
            raise _early(group, ended, started, logs)


def _early(group: Group, ended: list, started: set[int], logs: Path) -> LostProcessError:
    """Error for processes that ended early, each with its error or exit code."""
    # By an abort JAX ends those that have lost another, or have found none.
    number, why = min(ended, key=lambda one: (one[1] == -signal.SIGABRT, isinstance(one[1], int)))
    if why == -signal.SIGABRT:
        if number not in started:
            return _missing(group)
        why = "it has lost another one"
    why = f"exit code {why}" if isinstance(why, int) else why
    return LostProcessError(f"process {number} of {group.total} ended early ({why}); see {logs}")


def _missing(group: Group) -> LostProcessError:
    return LostProcessError(
        f"not all of {group.total} processes came up at {group.address}; start every one"
    )


def _messages(pipe: connection.Connection) -> list[tuple[str, Any]]:
    """New messages of a process: kind and value."""
    messages = []
    try:
        while pipe.poll():
            messages.append(pipe.recv())
    except (EOFError, OSError):
        pass
    return messages


def _child(
    work: Callable,
    arguments: tuple,
    group: Group,
    number: int,
    cores: int,
    wait: float,
    pipe: connection.Connection,
    log: Path,
) -> None:
    """One process: join the others, work, send the result to the parent."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    stream = os.fdopen(os.dup(2), "w") if number == min(group.own) else open(os.devnull, "w")
    log_file = os.open(log, os.O_WRONLY | os.O_CREAT)
    for descriptor in (1, 2):
        os.dup2(log_file, descriptor)
    try:
        use_cpu_devices(cores)
        bind = group.address if group.address.startswith(LOOPBACK) else None
        jax.distributed.initialize(
            group.address,
            group.total,
            number,
            cluster_detection_method="deactivate",
            initialization_timeout=int(wait) + 1,
            heartbeat_timeout_seconds=HEARTBEAT,
            coordinator_bind_address=bind,
        )
        jax.devices()
        pipe.send(("started", None))
        result = work(*arguments, stream=stream)
        jax.distributed.shutdown()
        stream.close()
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
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
    os._exit(1)


def _ignore_interrupts() -> Any:
    """Ignore Ctrl-C, where that is possible; returns the handler before."""
    if threading.current_thread() is not threading.main_thread():
        return None
    return signal.signal(signal.SIGINT, signal.SIG_IGN)


def _restore_interrupts(handler: Any) -> None:
    if handler is not None:
        signal.signal(signal.SIGINT, handler)
