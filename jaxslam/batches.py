"""Many of the same thing: a few at a time on each device, on all devices of all processes."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxslam import programs
from jaxslam.types import Array

FLAGS = {"--xla_force_host_platform_device_count": "{cores}"}
# By default XLA splits operations among the threads of all devices, and these are short.
FLAGS["--xla_disable_hlo_passes"] = "cpu-parallel-task-assigner"


def use_cores(cores: int | None = None) -> None:
    """Give JAX a device for each core of a CPU, which it leaves operations to as a whole.

    To be called before JAX does its first work: afterwards, or where JAX was told to use something
    else than the CPU, it does nothing. What the user has set in XLA_FLAGS stays.

    Args:
        cores: How many; by default all that this process may use.
    """
    if (jax.config.jax_platforms or "cpu").split(",")[0] != "cpu":
        return
    devices = jax.config.jax_num_cpu_devices
    try:
        # JAX refuses any other number once it has begun.
        jax.config.update("jax_num_cpu_devices", max(0, devices) + 1)
    except RuntimeError:
        return
    jax.config.update("jax_num_cpu_devices", devices)
    cores = cores or cores_here()
    given = os.environ.get("XLA_FLAGS", "")
    more = [f"{flag}={value.format(cores=cores)}" for flag, value in FLAGS.items()]
    more = [flag for flag in more if flag.split("=")[0] not in given]
    os.environ["XLA_FLAGS"] = " ".join([*given.split(), *more])


def cores_here() -> int:
    """Number of cores that this process may use."""
    own = getattr(os, "sched_getaffinity", None)
    return len(own(0)) if own else os.cpu_count() or 1


def one_by_one(function: Callable) -> Callable:
    """`function` that takes the items of a batch in turn on a CPU: each stays in its cache.

    What it gives is worked out once. Of operations on a whole batch XLA repeats those that look
    cheap in all that is made of their result, which for some on images takes most of the time.

    Args:
        function: Of arrays, or records of them, closing over none.
    """
    turns = custom_vmap(function)

    @turns.def_vmap
    def _(size: int, batched: Sequence[Any], *given: Any) -> tuple[Any, Any]:
        del size
        items, form = jax.tree.flatten(given)
        many = jax.tree.leaves(batched)

        def of_one(how: Callable, some: list[Array]) -> Any:
            left = iter(some)
            whole = [next(left) if one else x for x, one in zip(items, many, strict=True)]
            return how(*form.unflatten(whole))

        some = [x for x, one in zip(items, many, strict=True) if one]
        in_turn = partial(lax.map, partial(of_one, turns))
        together = jax.vmap(partial(of_one, function))
        result = lax.platform_dependent(some, cpu=in_turn, default=together)
        return result, jax.tree.map(lambda _: True, result)

    return turns


def map_batches(function: Callable, items: Any, *, size: int) -> Any:
    """Map `function` over the leading axis of `items`, `size` of them vectorised at a time.

    The last batch is filled up with the last item: unlike `lax.map(batch_size=...)` this compiles
    the function once.
    """
    count = jax.tree.leaves(items)[0].shape[0]
    size = min(size, count)
    items = pad(items, to=count + -count % size)
    fold = lambda x: x.reshape((-1, size) + x.shape[1:])
    result = lax.map(jax.vmap(function), jax.tree.map(fold, items))
    return jax.tree.map(lambda x: x.reshape((-1,) + x.shape[2:])[:count], result)


def pad(items: Any, *, to: int) -> Any:
    """Repeat the last of `items`, arrays that lead with one number, until there are `to`."""

    def longer(x: Any) -> Any:
        more = to - x.shape[0]
        if not more:
            return x
        on = jnp if isinstance(x, jax.Array) else np
        return on.concatenate([x, on.repeat(x[-1:], more, axis=0)])

    return jax.tree.map(longer, items)


class Spread:
    """A function of one item, compiled for `size` of them, for any number on all devices.

    Each device has a program of its own, the same for all, and takes `size` items at a time,
    vectorised: the result of an item depends neither on the other items nor on the number of
    devices or processes, bit for bit where the devices are alike. (XLA compiles a program for two
    devices to other roundings than one for one device.) Fewer items than fill the devices are
    vectorised more narrowly, and may differ by rounding. All processes must call it with the same
    arguments, and all get the whole result.
    """

    def __init__(self, function: Callable, *, size: int, static: int = 0):
        """Prepare it.

        Args:
            function: Of `static` hashable arguments, one record common to all, and one item.
            size: Items that a device works on together; one alone is not vectorised.
            static: Number of leading arguments that are static under jit.
        """
        self.size = size
        self._function = function
        self._static = static

    def __call__(self, *given: Any, devices: Sequence[jax.Device] | None = None) -> Any:
        """Results of the function, as NumPy arrays that lead with the number of items.

        Args:
            given: The static arguments, the common record, and the items, arrays that lead with
                their number.
            devices: To be used, as many of each process; all by default.
        """
        return self.begin(*given, devices=devices)()

    def begin(self, *given: Any, devices: Sequence[jax.Device] | None = None) -> Callable[[], Any]:
        """Start the work, with the arguments of a call, and return what waits for its results."""
        fixed, (common, items) = given[: self._static], given[self._static :]
        mesh = Mesh(np.array(jax.devices() if devices is None else devices), ("items",))
        count = jax.tree.leaves(items)[0].shape[0]
        size = min(self.size, -(-count // mesh.size))
        each = -(-count // (size * mesh.size))  # batches of a device
        items = pad(items, to=each * size * mesh.size)
        own = [(k, d) for k, d in enumerate(mesh.devices) if d in mesh.local_devices]
        common = [jax.device_put(common, device) for _, device in own]

        def batch(place: int, number: int, device: jax.Device) -> Any:
            first = (place * each + number) * size
            return jax.device_put(jax.tree.map(lambda x: x[first : first + size], items), device)

        shares = [[batch(k, number, device) for number in range(each)] for k, device in own]
        whole = self._function, *fixed
        lowered = [
            _run.trace(whole, known, share[0]).lower()
            for known, share in zip(common, shares, strict=True)
        ]
        with ThreadPoolExecutor(min(len(own), cores_here())) as pool:
            list(pool.map(lambda one: one.compile(), lowered))
        # One batch of every device after the other: none waits for the next.
        ready = [
            [_run(whole, known, one) for known, one in zip(common, now, strict=True)]
            for now in zip(*shares, strict=True)
        ]

        def finish() -> Any:
            whole = [_gather(mesh, parts) for parts in ready]

            def join(*rounds: np.ndarray) -> np.ndarray:
                x = np.stack([x.reshape(mesh.size, size, *x.shape[1:]) for x in rounds], axis=1)
                return x.reshape(-1, *x.shape[3:])[:count]

            return jax.tree.map(join, *whole)

        return finish


@partial(programs.jit, static_argnames="fixed")
def _run(fixed: tuple, common: Any, items: Any) -> Any:
    """A function, with its static arguments, of some items; one alone is not vectorised."""
    function = partial(*fixed, common)
    if jax.tree.leaves(items)[0].shape[0] > 1:
        return jax.vmap(function)(items)
    one = function(jax.tree.map(lambda x: x[0], items))
    return jax.tree.map(lambda x: x[None], one)


def _gather(mesh: Mesh, parts: list[Any]) -> Any:
    """What each device of a mesh has of a result, together, on all processes as NumPy arrays."""

    def whole(*parts: Array) -> Array:
        sharding = NamedSharding(mesh, PartitionSpec(mesh.axis_names))
        shape = (mesh.size * len(parts[0]), *parts[0].shape[1:])
        return jax.make_array_from_single_device_arrays(shape, sharding, parts)

    result = jax.tree.map(whole, *parts)
    if jax.process_count() > 1:
        return multihost_utils.process_allgather(result, tiled=True)
    return jax.tree.map(np.asarray, result)
