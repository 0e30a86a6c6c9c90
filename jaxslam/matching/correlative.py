"""Correlative search: where in a wide window a scan fits a submap, without a good guess.

ICP finds only what lies near its start. Here the points of the submap are drawn into a grid around
the guess, the likelihood field: in each cell a Gaussian of the distance to the nearest point,

    field(c) = exp(-distance(c)^2 / (2 std^2)).

A pose is scored by the mean of the field at the points of the scan. All poses of a window are
scored: for every heading the points are rotated once, and then all displacements by whole cells are
a window of the field around each point, so that the sum over points of these windows is the score
of all displacements at once. The work is the same whatever the scan shows.

The grid is parallel to the guess, so the result moves with guess and submap.

References:
    Olson (2009), Real-time correlative scan matching. Thrun, Burgard, Fox (2005), Probabilistic
    Robotics, section 6.4: likelihood fields.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.se2 import compose, relative, rotation, wrap_angle
from jaxslam.core.types import Array


class CorrelativeSpec(NamedTuple):
    """Options of the correlative search; static under jit.

    Attributes:
        cell: [m] side of a cell, and step of the displacements.
        extent: [m] from the guess to the border of the field; points beyond it do not count.
        std: [m] of the field: half a step of heading at some metres, and the walls' own roughness.
        max_displacement: [m] of the window to either side, along each axis.
        max_turn: [rad] of the window to either side.
        turn_step: [rad] between two headings.
        max_points: Points of the scan that are used at most, evenly spaced.
        num_candidates: C, poses that are returned.
        distinct: [m], [rad] beyond which two poses are different places.
        expected_std: [m], [rad] from the nearest pose that was expected, at which
        penalty: is subtracted from a score; it grows with the square,
        max_penalty: up to this: a robot may have been carried.
    """

    cell: float = 0.1
    extent: float = 15.0
    std: float = 0.15
    max_displacement: float = 1.0
    max_turn: float = 1.0
    turn_step: float = 0.04
    max_points: int = 64
    num_candidates: int = 2
    distinct: tuple[float, float] = (0.5, 0.3)
    expected_std: tuple[float, float] = (0.5, 0.75)
    penalty: float = 0.1
    max_penalty: float = 0.25


class Candidates(NamedTuple):
    """The best poses of a window, each at a different place, the best first.

    Attributes:
        poses: (C, 3) [m, m, rad].
        score: (C,) mean of the field at the points of the scan, 0 to 1.
    """

    poses: Array
    score: Array


def likelihood_field(spec: CorrelativeSpec, points: Array, valid: Array) -> Array:
    """Likelihood field (G, G) of points (N, 2) [m]; cell (i, j) is around x_i, y_j.

    The largest of the Gaussians around all points, up to two standard deviations: along x, then
    along y, as a Gaussian of a distance in the plane is the product of two.

    Args:
        spec: Options.
        points: (N, 2) [m] in the frame of the guess.
        valid: (N,) bool.
    """
    half = _half_size(spec)
    cell = jnp.round(points / spec.cell).astype(jnp.int32) + half
    cell = jnp.where(valid[:, None], cell, -1)
    cell = jnp.where(cell < 0, 2 * half + 1, cell)  # dropped, where -1 would count from the end
    field = jnp.zeros((2 * half + 1, 2 * half + 1), points.dtype)
    field = field.at[cell[:, 0], cell[:, 1]].set(1.0, mode="drop")
    reach = int(np.ceil(2.0 * spec.std / spec.cell))
    weights = np.exp(-0.5 * (spec.cell * np.arange(-reach, reach + 1) / spec.std) ** 2)
    for axis in (0, 1):
        padded = jnp.pad(field, [(reach, reach) if k == axis else (0, 0) for k in (0, 1)])
        shifted = [
            float(w) * lax.slice_in_dim(padded, k, k + 2 * half + 1, axis=axis)
            for k, w in enumerate(weights)
        ]
        field = jnp.stack(shifted).max(axis=0)
    return field


def window_scores(spec: CorrelativeSpec, field: Array, points: Array, hit: Array) -> Array:
    """Scores (A, S, S) of all headings and displacements of the window.

    Args:
        spec: Options.
        field: (G, G) likelihood field in the frame of the guess.
        points: (P, 2) [m] of the scan, robot frame.
        hit: (P,) bool, those of them that exist.
    """
    half, steps = _half_size(spec), _steps(spec.max_displacement, spec.cell)
    size = 2 * steps + 1
    padded = jnp.pad(field, steps)  # the window of cell (i, j) begins at (i, j)

    def at_heading(heading: Array) -> Array:
        cell = jnp.round(points @ rotation(heading).T / spec.cell).astype(jnp.int32) + half
        inside = hit & jnp.all((cell >= 0) & (cell <= 2 * half), axis=-1)

        def add(total: Array, point: tuple[Array, Array]) -> tuple[Array, None]:
            at, counts = point
            window = lax.dynamic_slice(padded, (at[0], at[1]), (size, size))
            return total + jnp.where(counts, window, 0.0), None

        total, _ = lax.scan(add, jnp.zeros((size, size), field.dtype), (cell, inside))
        return total / jnp.maximum(jnp.sum(hit, dtype=field.dtype), 1.0)

    return lax.map(at_heading, _headings(spec, field.dtype))


def surprise(spec: CorrelativeSpec, expected: Array, pose: Array) -> Array:
    """Score () that a pose (3,) loses for its distance from the nearest of poses (E, 3)."""
    off = pose[None] - expected
    square = (off[:, 0] ** 2 + off[:, 1] ** 2) / spec.expected_std[0] ** 2
    square = square + (wrap_angle(off[:, 2]) / spec.expected_std[1]) ** 2
    return jnp.minimum(spec.penalty * jnp.min(square), spec.max_penalty)


def search(
    spec: CorrelativeSpec,
    submap: Array,
    valid: Array,
    guess: Array,
    expected: Array,
    points: Array,
    hit: Array,
) -> Candidates:
    """The best poses of a scan in a window around a guess.

    Args:
        spec: Options.
        submap: (N, 2) [m] points of the submap.
        valid: (N,) bool, those of them that exist.
        guess: (3,) [m, m, rad] middle of the window, in the frame of the submap.
        expected: (E, 3) [m, m, rad] poses that are expected; others score less, by `surprise`.
        points: (R, 2) [m] of the scan, robot frame.
        hit: (R,) bool, those of them that exist.

    Returns:
        Candidates in the frame of the submap, their headings not wrapped.
    """
    every = -(-len(points) // spec.max_points)
    field = likelihood_field(spec, (submap - guess[None, :2]) @ rotation(guess[2]), valid)
    score = window_scores(spec, field, points[::every], hit[::every])
    offset = spec.cell * jnp.arange(-(score.shape[1] // 2), score.shape[1] // 2 + 1.0)
    headings = _headings(spec, field.dtype)
    expected = jax.vmap(relative, in_axes=(None, 0))(guess, expected)
    grid = jnp.stack(
        jnp.broadcast_arrays(offset[None, :, None], offset[None, None], headings[:, None, None]),
        axis=-1,
    )
    score = score - jax.vmap(partial(surprise, spec, expected))(grid.reshape(-1, 3)).reshape(
        score.shape
    )

    def take(left: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        best = jnp.argmax(left)
        k, i, j = jnp.unravel_index(best, left.shape)
        pose = jnp.stack([offset[i], offset[j], headings[k]])
        near = jnp.hypot(offset[:, None] - pose[0], offset[None] - pose[1]) < spec.distinct[0]
        turned = jnp.abs(headings - pose[2]) < spec.distinct[1]
        left = jnp.where(turned[:, None, None] & near[None], -jnp.inf, left)
        return left, (pose, score[k, i, j])

    _, (found, value) = lax.scan(take, score, length=spec.num_candidates)
    return Candidates(jax.vmap(compose, in_axes=(None, 0))(guess, found), value)


def _half_size(spec: CorrelativeSpec) -> int:
    """Cells from the middle of the field to its border."""
    return _steps(spec.extent, spec.cell)


def _steps(most: float, step: float) -> int:
    """Steps to either side of a window."""
    return max(1, round(most / step))


def _headings(spec: CorrelativeSpec, dtype: np.dtype) -> Array:
    """Headings (A,) [rad] of the window, from the guess's; ascending."""
    steps = _steps(spec.max_turn, spec.turn_step)
    return spec.turn_step * jnp.arange(-steps, steps + 1, dtype=dtype)
