"""Views of a map: what a scanner would measure at a position, compared with a query by heading.

A view is a function of bearing b and range r: how far the first wall is in each direction, with r
on a logarithmic axis, since a wall twice as far moves half as much when the robot moves a little.
Views agree where both have a wall at about the same range:

    agreement(heading) = sum_b sum_r map(b + heading, r) query(b, r)

This is a circular correlation over b, so its Fourier transform is a product, frequency by
frequency. Frequencies above `NUM_FREQUENCIES` are left out: they are finer than a step of heading.

References:
    Kim, Kim (2018), Scan Context: circular shifts of a polar descriptor. Reddy, Chatterji (1996),
    An FFT-based technique for translation, rotation, and scale-invariant image registration.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.types import Array

NUM_BEARINGS = 72
"""Bearings B of a view, and headings that are compared; a multiple of four."""

NUM_RANGES = 12
"""Ranges K of a view."""

RANGES = (0.6, 18.0)
"""[m] the first and the last of them; what is nearer or farther counts as that."""

NUM_FREQUENCIES = 24
"""Frequencies F of a view that are kept."""

CAST_STEPS = 48
"""Steps of a ray, each as long as is free in the map."""

AT_WALL = 0.75
"""Cells from a wall in which a ray ends."""

NOTHING = 100.0
"""[m] range of a ray that meets no wall."""

_PHASE = 2.0 * np.pi * np.outer(np.arange(NUM_FREQUENCIES), np.arange(NUM_BEARINGS)) / NUM_BEARINGS
_WEIGHT = np.where(np.arange(NUM_FREQUENCIES) == 0, 1.0, 2.0)[:, None] / NUM_BEARINGS


def cast_rays(cell: float, distance: Array, starts: Array, directions: Array) -> Array:
    """Ranges (N,) [m] to the first wall, in a grid of distances; `NOTHING` where there is none.

    Args:
        cell: [m] side of a cell.
        distance: (G, H) [m] of cells to the nearest wall.
        starts: (N, 2) [m] in the frame of the grid.
        directions: (N, 2) unit vectors.
    """
    last = jnp.array(distance.shape, jnp.int32) - 1

    def step(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        ranges, ended = state
        at = jnp.round((starts + ranges[:, None] * directions) / cell).astype(jnp.int32)
        inside = jnp.all((at >= 0) & (at <= last[None]), axis=1)
        at = at.clip(0, last[None])
        free = distance[at[:, 0], at[:, 1]]
        ended = ended | (free < AT_WALL * cell)
        step = jnp.maximum(free - 0.5 * cell, 0.5 * cell)
        ranges = jnp.where(ended, ranges, jnp.where(inside, ranges + step, NOTHING))
        return ranges, ended

    ranges = jnp.zeros_like(starts[:, 0])
    ranges, ended = lax.fori_loop(0, CAST_STEPS, step, (ranges, jnp.zeros(len(starts), bool)))
    return jnp.where(ended, ranges, NOTHING)


@partial(jax.jit, static_argnames="cell")
def views_of_map(cell: float, distance: Array, positions: Array) -> Array:
    """Spectra (2, K, N, F), real and imaginary, of the views at positions (N, 2) [m] of a grid."""
    bearing = 2.0 * np.pi / NUM_BEARINGS * np.arange(NUM_BEARINGS)
    directions = jnp.asarray(np.stack([np.cos(bearing), np.sin(bearing)], axis=-1), distance.dtype)
    starts = jnp.repeat(positions, NUM_BEARINGS, axis=0)
    ranges = cast_rays(cell, distance, starts, jnp.tile(directions, (len(positions), 1)))
    view = jnp.moveaxis(_shares(ranges.reshape(-1, NUM_BEARINGS)), -1, 0)
    return _spectrum(view)


def view_of_points(points: Array, valid: Array) -> Array:
    """Spectrum (2, K, F) of the view of points (P, 2) [m] around the origin."""
    bearing = jnp.arctan2(points[:, 1], points[:, 0]) * (NUM_BEARINGS / (2.0 * jnp.pi))
    low = jnp.floor(bearing)
    upper = (bearing - low)[:, None]
    at = low.astype(jnp.int32)
    shares = _shares(jnp.linalg.norm(points, axis=-1))
    shares = jnp.where(valid[:, None], shares, 0.0)
    view = jnp.zeros((NUM_BEARINGS, NUM_RANGES), points.dtype)
    view = view.at[at % NUM_BEARINGS].add(shares * (1.0 - upper))
    view = view.at[(at + 1) % NUM_BEARINGS].add(shares * upper)
    return _spectrum(view.T / jnp.maximum(jnp.sum(valid, dtype=view.dtype), 1.0))


def agreement(views: Array, query: Array) -> Array:
    """Agreement (N, B) of views (2, K, N, F) of a map with one (2, K, F) of a query, by heading."""
    real = sum(
        views[0, k] * query[0, k][None] + views[1, k] * query[1, k][None] for k in range(NUM_RANGES)
    )
    imaginary = sum(
        views[1, k] * query[0, k][None] - views[0, k] * query[1, k][None] for k in range(NUM_RANGES)
    )
    spectrum = jnp.concatenate([real, imaginary], axis=1)
    waves = np.concatenate([_WEIGHT * np.cos(_PHASE), -_WEIGHT * np.sin(_PHASE)])
    return spectrum @ jnp.asarray(waves, spectrum.dtype)


def _shares(ranges: Array) -> Array:
    """Shares (..., K) of the two neighbouring ranges of the axis; they add up to one."""
    low, high = np.log(RANGES)
    place = (jnp.log(ranges.clip(*RANGES)) - low) * float((NUM_RANGES - 1) / (high - low))
    steps = np.arange(NUM_RANGES).reshape((1,) * ranges.ndim + (-1,))
    return jnp.maximum(1.0 - jnp.abs(place[..., None] - jnp.asarray(steps, place.dtype)), 0.0)


def _spectrum(view: Array) -> Array:
    """Fourier transform (2, ..., F) of views (..., B)."""
    waves = np.stack([np.cos(_PHASE), -np.sin(_PHASE)])
    return jnp.einsum("...b,cfb->c...f", view, jnp.asarray(waves, view.dtype))
