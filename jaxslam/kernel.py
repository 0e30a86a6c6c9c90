"""How XLA is asked to compile small work on a CPU."""

from collections.abc import Callable
from functools import wraps
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata


def one_kernel(function: Callable) -> Callable:
    """`function` of arrays, which XLA is to compile to one kernel on a CPU, for one thread.

    By default each operation on more than 20 kB is split among all cores, which have to be woken
    for it. Where operations take microseconds, that is several times slower than one core is.
    Elsewhere than on a CPU nothing changes.

    Such a kernel cannot hold a scatter, a sort, a matrix product or a reduction of many numbers:
    they do not compile. Nor can that of a derivative, where a gather becomes a scatter. It is for
    what has a derivative by hand, or none.
    """
    own = jax.jit(function)

    @wraps(function)
    def call(*arguments: Any) -> Any:
        if jax.default_backend() != "cpu":
            return function(*arguments)
        with set_xla_metadata(inlineable="false", xla_cpu_small_call="true"):
            return own(*arguments)

    return call
