"""Normal equations of a run: a chain of poses, and landmarks that the poses see.

Their matrix is an arrow: tridiagonal in the poses, diagonal in the landmarks, sparse between. The
poses are eliminated one by one, as a filter does that knows the landmarks; what is left is dense
in the landmarks. Covariances are handed on: beside sharp odometry, inverse covariances would keep
nothing of the rest in single precision.

References:
    Triggs et al. (1999), Bundle adjustment: a modern synthesis, section 6. Rauch, Tung, Striebel
    (1965), Maximum likelihood estimates of linear dynamic systems.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.linalg import whiten
from jaxslam.types import Array

State = tuple[Array, Array]
"""Poses (T, 3) and places of landmarks (L, 2), or a step or a gradient of both."""


class Rows(NamedTuple):
    """What a step does to whitened residuals, J: motions' W (dx_t - F dx_t-1), and features'."""

    by_motion: Array  # (T, 3, 3) W
    transition: Array  # (T, 3, 3) F; the first is not used, as the pose before it is known
    spread: Array  # (T, 3, 3) (W^T W)^-1
    by_pose: Array  # (T, M, 2, 3), zero where masked
    by_place: Array  # (T, M, 2, 2), zero where masked
    at: Array  # (T, M) int32 landmark of the feature, any where masked


def times(matrix: Array, vector: Array) -> Array:
    """Products (..., k) of matrices (..., k, n) and vectors (..., n)."""
    return jnp.sum(matrix * vector[..., None, :], axis=-1)


def change(rows: Rows, step: State) -> State:
    """Change J step of the residuals of motions (T, 3) and of features (T, M, 2)."""
    poses, places = step
    before = jnp.pad(poses[:-1], ((1, 0), (0, 0)))
    motion = times(rows.by_motion, poses - times(rows.transition, before))
    return motion, times(rows.by_pose, poses[:, None]) + times(rows.by_place, places[rows.at])


def gradient(rows: Rows, residuals: State, size: int) -> State:
    """The transpose of `change`, J^T residuals, for `size` landmarks."""
    like = jnp.zeros_like(residuals[0]), jnp.zeros((size, 2), residuals[0].dtype)
    return jax.linear_transpose(lambda step: change(rows, step), like)(residuals)[0]


def blocks(rows: Rows, size: int) -> Array:
    """What features tell of landmarks (L, 2, 2) seen from known poses: diagonal of J^T J."""
    each = rows.by_place.swapaxes(-1, -2) @ rows.by_place
    return jnp.zeros((size, 2, 2), each.dtype).at[rows.at].add(each)


def solve(rows: Rows, extra: Array, right: State) -> State:
    """Solve (J^T J + extra) x = right.

    The derivative is that of the solution, not of how it was found.

    Args:
        rows: J.
        extra: (L, 2, 2) symmetric, what else is known of the landmarks.
        right: (T, 3) and (L, 2).

    Returns:
        x like `right`; NaN where the matrix is not positive definite.
    """
    size = extra.shape[0]

    def product(step: State) -> State:
        poses, places = gradient(rows, change(rows, step), size)
        return poses, places + times(extra, step[1])

    def solution(_: object, right: State) -> State:
        return _eliminate(rows, blocks(rows, size) + extra, right)

    return lax.custom_linear_solve(product, right, solution, symmetric=True)


def _eliminate(rows: Rows, diagonal: Array, right: State) -> State:
    """Solve as `solve` does, for diagonal blocks (L, 2, 2) of the landmarks.

    With l the landmarks' step and a last 1, the steps of poses up to one leave of it a Gaussian of
    mean B l and covariance P. Features there are x^T K x / 2 + x^T C l + ..., so that

        D = K B + C    P' = (P^-1 + K)^-1    B' = B - P' D    l^T (C^T B + D^T B') l / 2

    are what is left, and the last is what landmarks learn, up to their diagonal.
    """
    steps, size = rows.at.shape[0], diagonal.shape[0]
    by_pose = rows.by_pose.swapaxes(-1, -2)
    cross = jnp.zeros((steps, size, 3, 2), diagonal.dtype)
    cross = cross.at[jnp.arange(steps)[:, None], rows.at].add(by_pose @ rows.by_place)
    cross = cross.swapaxes(1, 2).reshape(steps, 3, 2 * size)
    cross = jnp.concatenate([cross, -right[0][..., None]], axis=2)  # C (T, 3, 2 L + 1)
    known = jnp.sum(by_pose @ rows.by_pose, axis=1)  # K (T, 3, 3)
    eye = jnp.eye(3, dtype=known.dtype)

    keep = 1 + 2 * jnp.finfo(known.dtype).eps * eye  # so that P stays positive under rounding

    def forward(state: State, now: tuple[Array, ...]) -> tuple[State, tuple[Array, ...]]:
        (cov, mean), (f, spread, known, cross) = state, now
        ahead, mean = (f @ cov @ f.T + spread) * keep, f @ mean
        white = whiten(ahead, jnp.concatenate([ahead, f @ cov, eye], axis=1))
        root, gain = white[:, :3], white[:, 3:6].T @ white[:, 6:]  # P = root^T root
        root = whiten(eye + root @ known @ root.T, root)  # and P'
        pull = known @ mean + cross
        after = mean - root.T @ (root @ pull)
        return (root.T @ root, after), (mean, after, pull, gain)

    start = jnp.zeros_like(eye), jnp.zeros_like(cross[0])
    now = (rows.transition, rows.spread, known, cross)
    _, (means, after, pull, gain) = lax.scan(forward, start, now)

    flat = lambda *x: jnp.concatenate(x, axis=1).reshape(6 * steps, -1)
    index = jnp.arange(size)
    square = jnp.zeros((size, 2, size, 2), known.dtype).at[index, :, index].set(diagonal)
    learnt = flat(cross, pull).T @ flat(means, after)
    learnt = (learnt + learnt.T)[:-1] / 2
    left = learnt[:, :-1] + square.reshape(2 * size, -1)
    places = _gauss_jordan(left, right[1].reshape(-1) - learnt[:, -1])
    last = jnp.append(places, jnp.ones((), places.dtype))

    def backward(late: Array, now: tuple[Array, ...]) -> tuple[Array, Array]:
        mean, after, gain = now
        pose = after + late
        return gain @ (pose - mean), pose

    _, poses = lax.scan(
        backward, jnp.zeros_like(eye[0]), (means @ last, after @ last, gain), reverse=True
    )
    return poses, places.reshape(-1, 2)


def _gauss_jordan(matrix: Array, right: Array) -> Array:
    """Solution (n,) for a positive definite matrix (n, n) and right side (n,).

    In array operations alone, for the reason told in `linalg`; not unrolled, as n is large.
    """

    def body(left: Array, k: Array) -> tuple[Array, None]:
        row = left[k] / jnp.where(left[k, k] > 0.0, left[k, k], jnp.nan)
        return (left - left[:, k, None] * row[None]).at[k].set(row), None

    left = jnp.concatenate([matrix, right[:, None]], axis=1)
    return lax.scan(body, left, jnp.arange(right.size))[0][:, -1]
