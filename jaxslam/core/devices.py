"""Devices: one CPU device per core, and a map of a function over all devices and processes."""

import os
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from functools import cache, lru_cache, partial, wraps
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxslam.core import trace_cache
from jaxslam.core.batching import BatchSize, leading_size, pad_to, traced_platform
from jaxslam.core.types import Array

XLA_FLAGS = {
    "--xla_force_host_platform_device_count": "{cores}",
    # By default XLA splits operations among the threads of all devices, and these are short.
    "--xla_disable_hlo_passes": "cpu-parallel-task-assigner",
}

MAX_PROGRAMS = 12
"""Compiled programs that a process keeps, those used last.

One for CPUs has up to 3,500 parts in memory, and Linux allows a process 65,530 of them.
"""


def use_cpu_devices(num_devices: int | None = None) -> None:
    """Make each CPU core a device of JAX, and let XLA run each operation on one core.

    Call it before JAX does its first work: once JAX has started its backends their devices are
    fixed, and this does nothing. It does nothing either where `jax_platforms` names another
    platform than the CPU first. Flags that XLA_FLAGS holds already keep their values.

    Args:
        num_devices: Number of devices; by default all cores that this process may use.

    Raises:
        ValueError: `num_devices` is below 1.
    """
    if num_devices is not None and num_devices < 1:
        raise ValueError(f"num_devices is {num_devices}, not 1 or more")
    first_platform = (trace_cache.setting("jax_platforms") or "cpu").split(",")[0]
    if first_platform != "cpu" or _backends_started():
        return
    count = num_devices or num_cores()
    present = os.environ.get("XLA_FLAGS", "")
    flags = [f"{flag}={value.format(cores=count)}" for flag, value in XLA_FLAGS.items()]
    added = [flag for flag in flags if flag.split("=")[0] not in present]
    os.environ["XLA_FLAGS"] = " ".join([*present.split(), *added])


def _backends_started() -> bool:
    """Whether JAX has fixed its devices: after that it refuses to change their number.

    JAX has no public function that says so without starting the backends, so a change is tried
    and undone.
    """
    devices = trace_cache.setting("jax_num_cpu_devices")
    try:
        jax.config.update("jax_num_cpu_devices", max(0, devices) + 1)
    except RuntimeError:
        return True
    jax.config.update("jax_num_cpu_devices", devices)
    return False


def num_cores() -> int:
    """Number of CPU cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


class DeviceMap:
    """Map a function over any number of items on all devices, `size` of them vectorised at a time.

    Device k of D gets a contiguous block of the items, as `rounds` batches of `size`; the last
    item is repeated until all batches are full. 19 items, D = 2, size = 4, three rounds:

                    round 0        round 1        round 2
        device 0    items 0-3      items 4-7      items 8-11
        device 1    items 12-15    items 16-18,-  -  -  -  -       (-: copy of item 18)

    The host compiles, puts all batches of all devices into their queues without waiting, and
    returns; results are waited for later:

        host        compile | enqueue |  free for other work   | wait, gather |
        device 0                 | round 0 | round 1 | round 2 |
        device 1                 | round 0 | round 1 | round 2 |

    CPU devices of a process share their memory, and so one compiled program, which each runs in a
    thread of its own; other devices have a program each, all from the same trace. So the result of
    an item depends neither on the other items nor on the number of devices or processes, bit for
    bit where the devices are alike. (One program for several devices, sharded by XLA, is compiled
    to other roundings than a program for one.) Only where there are fewer items than D * size are
    batches smaller, and results may differ by rounding.

    All processes must call it with the same arguments, and all get the whole result.
    """

    def __init__(
        self,
        function: Callable,
        *,
        size: int | BatchSize,
        static: int = 0,
        compile_quickly: bool = False,
    ):
        """Wrap a function of one item.

        Args:
            function: Of `static` hashable arguments, one record common to all items, and one item.
            size: Items of a batch, of a `BatchSize` those of the devices; a single one is not
                vectorised.
            static: Number of leading arguments that are static under jit.
            compile_quickly: As of `trace_cache.jit`.

        Raises:
            ValueError: `size` is below 1, or `static` below 0.
        """
        if min(size if isinstance(size, BatchSize) else (size,)) < 1:
            raise ValueError(f"size is {size}, not 1 or more")
        if static < 0:
            raise ValueError(f"static is {static}, not 0 or more")
        self.size = size
        self._function = function
        self._static = static
        self._quick = compile_quickly

    def __call__(self, *args: Any, devices: Sequence[jax.Device] | None = None) -> Any:
        """Results of the function, as NumPy arrays that lead with the number of items.

        Args:
            args: The static arguments, the common record, and the items: arrays that lead with
                their number.
            devices: To be used, as many of each process; all by default.

        Raises:
            ValueError: There are too few or too many arguments, no items, or arrays of items that
                differ in length.
        """
        return self.begin(*args, devices=devices)()

    def begin(self, *args: Any, devices: Sequence[jax.Device] | None = None) -> Callable[[], Any]:
        """Start the work, with the arguments of a call.

        Returns:
            A function without arguments that waits for the results and returns them.

        Raises:
            ValueError: As of a call.
        """
        if len(args) != self._static + 2:
            wanted = f"{self._static} static ones, the common record and the items"
            raise ValueError(f"{len(args)} arguments, not {wanted}")
        static, (common, items) = args[: self._static], args[self._static :]
        count = leading_size("items", items)
        mesh = Mesh(np.array(jax.devices() if devices is None else devices), ("items",))
        most = self.size
        if isinstance(most, BatchSize):
            most = most.on(mesh.devices[0].platform)
        size = min(most, -(-count // mesh.size))
        rounds = -(-count // (size * mesh.size))
        items = pad_to(items, to=mesh.size * rounds * size)

        def batch_on(device: jax.Device, number: int) -> Any:
            own = slice(number * size, (number + 1) * size)
            return jax.device_put(jax.tree.map(lambda x: x[own], items), device)

        # Arguments to the devices of this process; the others serve the rest of the mesh.
        local = [(k, d) for k, d in enumerate(mesh.devices) if d in mesh.local_devices]
        on_cpu = _is_cpu(local[0][1])
        homes = [local[0][1] if on_cpu else device for _, device in local]
        common_of = {home: jax.device_put(common, home) for home in homes}
        batches_of = [
            [batch_on(home, k * rounds + r) for r in range(rounds)]
            for (k, _), home in zip(local, homes, strict=True)
        ]

        program = self._function, *static
        firsts = [batches_of[homes.index(home)][0] for home in common_of]
        run = _runner(self._quick, program, _shapes((common_of[homes[0]], firsts[0])))
        compiled = _compile(run, program, [*common_of.values()], firsts)
        run_on = dict(zip(common_of, compiled, strict=True))

        def work(home: jax.Device, batch: Any) -> Any:
            result = run_on[home](common=common_of[home], items=batch)
            return jax.block_until_ready(result) if on_cpu else result

        # One batch of every device after the other, so that none idles.
        results = [
            [
                _queue(device).submit(work, home, batch)
                for (_, device), home, batch in zip(local, homes, batches, strict=True)
            ]
            for batches in zip(*batches_of, strict=True)
        ]

        def finish() -> Any:
            try:
                by_round = [_gather(mesh, [one.result() for one in parts]) for parts in results]
            except BaseException:  # Ctrl-C, too: what is not begun is left out
                _cancel(results)
                raise
            ordered = partial(_in_order, devices=mesh.size, size=size)
            return jax.tree.map(lambda *parts: ordered(parts)[:count], *by_round)

        return finish


def _is_cpu(device: jax.Device) -> bool:
    """Whether a device shares its memory with the others of the process."""
    return device.platform == "cpu"


@cache
def _queue(device: jax.Device) -> ThreadPoolExecutor:
    """The thread of a device, which does what it is given in order.

    Of a single thread XLA would run short programs of several CPU devices one after the other.
    """
    return ThreadPoolExecutor(1, thread_name_prefix=f"{device.platform}-{device.id}")


def _cancel(results: list[list[Future]]) -> None:
    for parts in results:
        for one in parts:
            one.cancel()


def _shapes(arrays: Any) -> Hashable:
    """Structure, shapes and types of arrays: with other ones a function is another program."""
    leaves, tree = jax.tree.flatten(arrays)
    return tree, tuple(map(jax.typeof, leaves))


@lru_cache(maxsize=MAX_PROGRAMS)
def _runner(quick: bool, program: tuple, shapes: Hashable) -> trace_cache.CachedJit:
    """`_run`, jitted for one program; when it is dropped, what it has compiled is freed.

    Args:
        quick: Whether to compile quickly.
        program: The function of a `DeviceMap`, and its static arguments.
        shapes: `_shapes` of the common record and of the items.
    """

    @wraps(_run)  # JAX frees what it has compiled of a function with the function
    def run(program: tuple, common: Any, items: Any) -> Any:
        return _run(program, common, items)

    return trace_cache.jit(run, static_argnames="program", compile_quickly=quick)


def _compile(
    run: trace_cache.CachedJit, program: tuple, common_of: list[Any], batch_of: list[Any]
) -> list[Callable[..., Any]]:
    """Compile `_run` for several devices, in parallel: XLA does not hold Python's lock.

    Tracing and lowering do, and come first. The programs stay in JAX's cache, where the next call
    finds them.
    """

    def lower(common: Any, batch: Any) -> Callable[[], Callable[..., Any]]:
        device = jax.tree.leaves(batch)[0].device
        other = device.platform != traced_platform()  # batches of another size
        with jax.default_device(device) if other else nullcontext():
            return run.lower(program=program, common=common, items=batch)

    lowered = list(map(lower, common_of, batch_of))
    with ThreadPoolExecutor(min(len(lowered), num_cores())) as pool:
        return list(pool.map(lambda each: each(), lowered))


def _run(program: tuple, common: Any, items: Any) -> Any:
    """Results of one batch, arrays that lead with its size; a single item is not vectorised.

    Args:
        program: The function of a `DeviceMap`, and its static arguments.
        common: The record common to all items.
        items: The batch: arrays that lead with its size.
    """
    called, *static = program
    function = partial(called, *static, common)
    if jax.tree.leaves(items)[0].shape[0] > 1:
        return jax.vmap(function)(items)
    single = function(jax.tree.map(lambda x: x[0], items))
    return jax.tree.map(lambda x: x[None], single)


def _gather(mesh: Mesh, parts: list[Any]) -> Any:
    """Results of one round of all devices, as NumPy arrays (D * size, ...) on all processes.

    Args:
        mesh: The D devices.
        parts: The results (size, ...) of those of this process, in the order of the mesh.
    """
    if jax.process_count() == 1:
        return jax.tree.map(lambda *x: np.concatenate([np.asarray(one) for one in x]), *parts)
    local = [device for device in mesh.devices if device in mesh.local_devices]

    def sharded(*shards: Array) -> Array:
        sharding = NamedSharding(mesh, PartitionSpec(mesh.axis_names))
        shape = (mesh.size * len(shards[0]), *shards[0].shape[1:])
        placed = [jax.device_put(x, device) for x, device in zip(shards, local, strict=True)]
        return jax.make_array_from_single_device_arrays(shape, sharding, placed)

    return multihost_utils.process_allgather(jax.tree.map(sharded, *parts), tiled=True)


def _in_order(by_round: Sequence[np.ndarray], *, devices: int, size: int) -> np.ndarray:
    """Join the arrays (D * size, ...) of all rounds in the order of the items: device by device."""
    split = [x.reshape(devices, size, *x.shape[1:]) for x in by_round]
    by_device = np.stack(split, axis=1)  # (D, rounds, size, ...)
    return by_device.reshape(-1, *by_device.shape[3:])
