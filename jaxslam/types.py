"""Array aliases, and the letters, units and frames used everywhere.

Letters: S walls, R beams, H x W cells, K runs, M features of a scan, L landmarks, A arcs,
D = 3 + 2 L state, T steps, B runs of the robot.

Units: metres and radians. Frames: *world* (or *map*: the world as the robot estimates it) and
*robot* (x ahead, y to the left, heading counter-clockwise from x). A pose (3,) is x, y, heading
in the world; a motion (3,) is a pose in the frame of the pose before it.

Grids: cell [i, j] covers a square of the robot frame; i grows with x (ahead), j with y (left).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array
"""Any array; its shape, unit and frame stand in the docstring of what uses it."""

Key = jax.Array
"""A key made by `jax.random.key`."""

NODE, CORNER, WALL = 0, 1, 2
"""The kinds of landmark: junction of the Voronoi diagram, corner of two walls, wall direction."""


def expect(name: str, x: Any, shape: tuple[Any, ...], kind: Any = None) -> None:
    """Raise ValueError unless `x` has a shape and a type; while tracing, so it costs no run time.

    Args:
        name: Of `x`, for the message.
        x: An array.
        shape: Its sizes; a letter stands for any size, `...` in front for any leading sizes.
        kind: Its dtype or a family of dtypes, such as `jnp.floating`; None for any.

    Raises:
        ValueError: It has not; the message tells what it is and what it should be.
    """
    sizes, dtype = np.shape(x), jnp.result_type(x)
    last = shape[1:] if shape[:1] == (...,) else shape
    ends = sizes[-len(last) :] if last is not shape else sizes
    fits = len(ends) == len(last) and all(
        isinstance(want, str) or size == want for size, want in zip(ends, last, strict=True)
    )
    if not fits or not (kind is None or jnp.issubdtype(dtype, kind)):
        wanted = ", ".join("..." if n is ... else str(n) for n in shape)
        wanted += "," if len(shape) == 1 else ""
        of = "" if kind is None else f"{np.dtype(kind) if kind is jnp.bool_ else kind.__name__} "
        raise ValueError(f"{name} is {dtype} {sizes}, not {of}({wanted})")


def expect_covariance(name: str, cov: Array, *, definite: bool = True) -> None:
    """Raise ValueError unless `cov` (..., n, n) is finite, symmetric and positive definite.

    While tracing there are no values to look at, and nothing is checked.

    Args:
        name: Of `cov`, for the message.
        cov: The matrices.
        definite: False lets semi-definite ones pass: something known for certain.

    Raises:
        ValueError: One is not; the message tells which, and why.
    """
    if isinstance(cov, jax.core.Tracer):
        return
    all = np.asarray(cov, float)
    for index in np.ndindex(all.shape[:-2]):
        one, where = all[index], name + (str(list(index)) if index else "")
        if not np.isfinite(one).all():
            raise ValueError(f"{where} holds numbers that are not finite")
        scale = np.abs(one).max()
        if np.abs(one - one.T).max() > 1e-5 * scale:
            i, j = np.unravel_index(np.argmax(np.abs(one - one.T)), one.shape)
            raise ValueError(
                f"{where} is not symmetric: [{i}, {j}] is {one[i, j]:g}, [{j}, {i}] {one[j, i]:g}"
            )
        least = np.linalg.eigvalsh((one + one.T) / 2)[0]
        if not (least > 0.0 if definite else least >= -1e-6 * scale):
            wanted = "positive definite" if definite else "positive semi-definite"
            raise ValueError(f"{where} is not {wanted}: its least eigenvalue is {least:g}")
