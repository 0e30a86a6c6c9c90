"""The nearest of many things along each beam of a scan, as fast as XLA allows on each platform.

On a CPU, XLA vectorises an operation on all beams for one thing after another, but no reduction
over the things: a loop over them, a few in each step, is several times as fast. Beams and things
must meet in its body without a gather: one number gathered costs as much as ten walls tried.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.types import Array

UNROLL = 8  # things in each step of the loop
NONE = np.iinfo(np.int32).max  # a number after all others

Beams = tuple[Array, Array]
"""x and y of the unit vectors of beams, world frame."""

Nearest = tuple[Array, Array]
"""Distances [m] along beams, and the numbers of what they meet, int32."""

Distance = Callable[[Beams, Any], Array]
"""Distances [m] along beams to things, infinite where they are not met."""


def search(distance: Distance, beams: Beams, things: Any) -> Nearest:
    """What is nearest along each beam, by trying all.

    Args:
        distance: Of beams to things; those whose numbers are all 0 must not be met.
        beams: Of (R,) beams.
        things: A record of arrays (K,), K >= 1.

    Returns:
        Distances (R,), infinite where nothing is met, and numbers (R,), there -1. Of equal
        distances it is the first thing.
    """
    loop, dense = partial(_one_by_one, distance), partial(_all_at_once, distance)
    return lax.platform_dependent(beams, things, cpu=loop, default=dense)


def nearest_of(best: Nearest, distances: Sequence[Array], numbers: Sequence[Array]) -> Nearest:
    """The best of what was found before and of more; of equals the first number, `NONE` of none.

    Distances come first and numbers after them: XLA leaves the numbers out where nothing needs
    them.
    """
    nearest = reduce(jnp.minimum, distances, best[0])
    number = jnp.where(best[0] == nearest, best[1], NONE)
    for distance, own in zip(distances, numbers, strict=True):
        number = jnp.where(distance == nearest, jnp.minimum(number, own), number)
    return nearest, number


def with_none(best: Nearest) -> Nearest:
    """Distances and numbers, -1 where nothing is met."""
    return best[0], jnp.where(jnp.isfinite(best[0]), best[1], -1)


def _all_at_once(distance: Distance, beams: Beams, things: Any) -> Nearest:
    """Search by a reduction."""
    x_y = beams[0][:, None], beams[1][:, None]
    table = distance(x_y, jax.tree.map(lambda x: x[None], things))  # (R, K)
    nearest = jnp.min(table, axis=1)
    return with_none((nearest, jnp.argmin(table, axis=1).astype(jnp.int32)))


def _one_by_one(distance: Distance, beams: Beams, things: Any) -> Nearest:
    """Search by a loop."""
    leaves, treedef = jax.tree.flatten(things)
    table = jnp.stack(leaves, axis=1)  # (K, N)
    table = jnp.pad(table, ((0, -len(table) % UNROLL), (0, 0)))
    steps = table.reshape(-1, UNROLL, len(leaves))

    def body(state: tuple[Nearest, Array], step: Array) -> tuple[tuple[Nearest, Array], None]:
        best, first = state
        each = [jax.tree.unflatten(treedef, [x[i] for i in range(len(leaves))]) for x in step]
        numbers = [first + k for k in range(UNROLL)]
        return (nearest_of(best, [distance(beams, x) for x in each], numbers), first + UNROLL), None

    none = jnp.full_like(beams[0], jnp.inf), jnp.full(beams[0].shape, NONE)
    return with_none(lax.scan(body, (none, jnp.int32(0)), steps)[0][0])
