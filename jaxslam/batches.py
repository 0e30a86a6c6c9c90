"""Many of the same thing: a few at a time on each device, on all devices of all processes."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxslam.types import Array


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
    """A function of one item, compiled once, for any number of them on all devices.

    Each device takes `size` items at a time, vectorised, so that the result of an item depends
    neither on the other items nor on the number of devices or processes, bit for bit where the
    devices are alike (fewer items than fill the devices are vectorised more narrowly, and may
    differ by rounding). All processes must call it with the same arguments, and all get the whole
    result.
    """

    def __init__(self, function: Callable, *, size: int, static: int = 0):
        """Prepare it.

        Args:
            function: Of `static` hashable arguments, one record common to all, and one item.
            size: Items that a device works on together.
            static: Number of leading arguments that are static under jit.
        """
        self.size = size
        self._function = function
        self._compiled = jax.jit(self._run, static_argnums=tuple(range(static + 2)))

    def __call__(self, *given: Any, devices: Sequence[jax.Device] | None = None) -> Any:
        """Results of the function, as NumPy arrays that lead with the number of items.

        Args:
            given: The static arguments, the common record, and the items, arrays that lead with
                their number.
            devices: To be used; all by default.
        """
        *fixed, common, items = given
        mesh = Mesh(np.array(jax.devices() if devices is None else devices), ("items",))
        count = jax.tree.leaves(items)[0].shape[0]
        size = min(self.size, -(-count // mesh.size))
        items = pad(items, to=count + -count % (size * mesh.size))
        common = jax.tree.map(partial(_place, mesh, PartitionSpec()), common)
        items = jax.tree.map(partial(_place, mesh, PartitionSpec("items")), items)
        result = self._compiled(mesh, size, *fixed, common, items)
        if jax.process_count() > 1:
            result = multihost_utils.process_allgather(result, tiled=True)
        return jax.tree.map(lambda x: np.asarray(x)[:count], result)

    def _run(self, mesh: Mesh, size: int, *given: Any) -> Any:
        *fixed, common, items = given

        def share(common: Any, items: Any) -> Any:
            return map_batches(partial(self._function, *fixed, common), items, size=size)

        # Nothing passes between the devices: there is nothing to check of what varies among them.
        along = PartitionSpec("items")
        specs = {"in_specs": (PartitionSpec(), along), "out_specs": along, "check_vma": False}
        return jax.shard_map(share, mesh=mesh, **specs)(common, items)


def _place(mesh: Mesh, spec: PartitionSpec, x: Array | np.ndarray) -> Array:
    """An array on the devices of a mesh, those of other processes among them."""
    sharding = NamedSharding(mesh, spec)
    if jax.process_count() == 1:
        return jax.device_put(x, sharding)
    x = np.asarray(x)
    return jax.make_array_from_callback(x.shape, sharding, lambda index: x[index])
