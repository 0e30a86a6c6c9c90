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

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.se2 import compose, rotation, wrap_angle
from jaxslam.core.types import Array


class CorrelativeSpec(NamedTuple):
    """Options of the correlative search; static under jit.

    Attributes:
        cell: [m] side of a cell, and step of the displacements.
        extent: [m] from the guess to the border of the field; points beyond it do not count.
        std: [m] of the field: half a step of heading at some metres, and the walls' own roughness.
        max_displacement: [m] of the window to either side, along each axis.
        max_turn: [rad] of the window to either side, where not all headings are searched.
        turn_step: [rad] between two headings.
        max_points: Points of the scan that are used at most, evenly spaced.
        num_candidates: C, poses that are returned.
        distinct: [m], [rad] beyond which two poses are different places.
        score_scale: Score that a pose loses where it is e times less likely than the likeliest.
        max_penalty: Score that it loses at most: a robot may have been carried.
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
    score_scale: float = 0.02
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


def window_scores(
    spec: CorrelativeSpec,
    field: Array,
    log_density: Callable[[Array], Array],
    points: Array,
    hit: Array,
    every_heading: Array,
) -> Array:
    """Scores (A, S, S) of all headings of a whole turn and all displacements of the window.

    Args:
        spec: Options.
        field: (G, G) likelihood field in the frame of the guess.
        log_density: Of a pose (3,) in that frame, as of `search`.
        points: (P, 2) [m] of the scan, robot frame.
        hit: (P,) bool, those of them that exist.
        every_heading: () bool; if not, headings further than `spec.max_turn` from the guess's are
            not looked at, and have no score, -inf.
    """
    half, steps = _half_size(spec), _steps(spec.max_displacement, spec.cell)
    size = 2 * steps + 1
    padded = jnp.pad(field, steps)  # the window of cell (i, j) begins at (i, j)
    all_headings, offset = headings(spec, field.dtype), displacements(spec, field.dtype)
    shifts = jnp.stack(jnp.meshgrid(offset, offset, indexing="ij"), axis=-1).reshape(-1, 2)
    middle = len(all_headings) // 2
    some = min(_steps(spec.max_turn, spec.turn_step), middle)
    reach = jnp.where(every_heading, jnp.int32(middle), jnp.int32(some))

    def at_heading(k: Array, scores: Array) -> Array:
        turned = points @ rotation(all_headings[k]).T
        cell = jnp.round(turned / spec.cell).astype(jnp.int32) + half
        inside = hit & jnp.all((cell >= 0) & (cell <= 2 * half), axis=-1)

        def add(total: Array, point: tuple[Array, Array]) -> tuple[Array, None]:
            at, counts = point
            window = lax.dynamic_slice(padded, (at[0], at[1]), (size, size))
            return total + jnp.where(counts, window, 0.0), None

        total, _ = lax.scan(add, jnp.zeros((size, size), field.dtype), (cell, inside))
        turn = jnp.full((len(shifts), 1), all_headings[k])
        poses = jnp.concatenate([shifts, turn], axis=1)
        unlikely = surprise(spec, jax.vmap(log_density)(poses)).reshape(size, size)
        count = jnp.maximum(jnp.sum(hit, dtype=field.dtype), 1.0)
        return scores.at[k].set(total / count - unlikely)

    scores = jnp.full((len(all_headings), size, size), -jnp.inf, field.dtype)
    return lax.fori_loop(
        jnp.int32(middle) - reach, jnp.int32(middle + 1) + reach, at_heading, scores
    )


def surprise(spec: CorrelativeSpec, log_density: Array) -> Array:
    """Score that poses lose for being unlikely, from the logarithms of their densities."""
    return jnp.minimum(-spec.score_scale * log_density, spec.max_penalty)


def search(
    spec: CorrelativeSpec,
    submap: Array,
    valid: Array,
    guess: Array,
    log_density: Callable[[Array], Array],
    points: Array,
    hit: Array,
    every_heading: Array,
) -> Candidates:
    """The best poses of a scan in a window around a guess.

    Args:
        spec: Options.
        submap: (N, 2) [m] points of the submap.
        valid: (N,) bool, those of them that exist.
        guess: (3,) [m, m, rad] middle of the window, in the frame of the submap.
        log_density: Of a pose (3,) in that frame, before the scan is looked at; () up to a
            constant. Less likely poses score less, by `surprise`.
        points: (R, 2) [m] of the scan, robot frame.
        hit: (R,) bool, those of them that exist.
        every_heading: () bool, whether all headings are searched or those of the window.

    Returns:
        Candidates in the frame of the submap, their headings not wrapped.
    """
    every = -(-len(points) // spec.max_points)
    field = likelihood_field(spec, (submap - guess[None, :2]) @ rotation(guess[2]), valid)

    def density_from_guess(pose: Array) -> Array:
        return log_density(compose(guess, pose))

    thinned = points[::every], hit[::every]
    score = window_scores(spec, field, density_from_guess, *thinned, every_heading)
    offset, turn = displacements(spec, field.dtype), headings(spec, field.dtype)

    def take(left: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        k, i, j = jnp.unravel_index(jnp.argmax(left), left.shape)
        near = jnp.hypot(offset[:, None] - offset[i], offset[None] - offset[j]) < spec.distinct[0]
        turned = jnp.abs(wrap_angle(turn - turn[k])) < spec.distinct[1]
        left = jnp.where(turned[:, None, None] & near[None], -jnp.inf, left)
        return left, (jnp.stack([offset[i], offset[j], turn[k]]), score[k, i, j])

    _, (found, value) = lax.scan(take, score, length=spec.num_candidates)
    return Candidates(jax.vmap(compose, in_axes=(None, 0))(guess, found), value)


def displacements(spec: CorrelativeSpec, dtype: np.dtype) -> Array:
    """Displacements (S,) [m] of the window along an axis, ascending."""
    steps = _steps(spec.max_displacement, spec.cell)
    return spec.cell * jnp.arange(-steps, steps + 1, dtype=dtype)


def headings(spec: CorrelativeSpec, dtype: np.dtype) -> Array:
    """Headings (A,) [rad] of a whole turn, from the guess's, which is in the middle; ascending."""
    steps = int(np.pi / spec.turn_step)
    return spec.turn_step * jnp.arange(-steps, steps + 1, dtype=dtype)


def _half_size(spec: CorrelativeSpec) -> int:
    """Cells from the middle of the field to its border."""
    return _steps(spec.extent, spec.cell)


def _steps(most: float, step: float) -> int:
    """Steps to either side of a window."""
    return max(1, round(most / step))
