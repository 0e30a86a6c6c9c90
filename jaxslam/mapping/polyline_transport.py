"""A polyline moved with the landmarks at its ends."""

import jax.numpy as jnp

from jaxslam.core.types import Array

MIN_CHORD = 0.3  # [m] a chord shorter than this has no reliable direction


def attach_polyline(line: Array, first: Array, last: Array) -> Array:
    """Transport a polyline onto new end points: rotate it with its chord, then close the gap.

    With points p_1..p_K, chords old = p_K - p_1 and new = last - first, and R the rotation from the
    direction of old to that of new,

        q_k = first + R (p_k - p_1) + s_k (new - R old)        s_k = (k - 1) / (K - 1)

    so that q_1 = first and q_K = last. The form is kept; a change of the chord's length is spread
    evenly over the points. R is the identity if a chord is shorter than `MIN_CHORD`, as in a loop.

           stored              rotated with its chord        gap closed

                                          x last                o last
             .--.                       o                     .'
           .'    '.                  .-'                   .-'
          o        o                /                     /
         p_1      p_K        first o               first o

    Args:
        line: (..., K, 2) [m] points at equal distances.
        first: (..., 2) [m] new first point.
        last: (..., 2) [m] new last point.

    Returns:
        (..., K, 2) [m].
    """
    old, new = line[..., -1, :] - line[..., 0, :], last - first
    chords = jnp.stack([old, new], axis=-2)
    has_direction = jnp.min(jnp.linalg.norm(chords, axis=-1), axis=-1) > MIN_CHORD
    x, y = chords[..., 0], chords[..., 1]
    dot = jnp.where(has_direction, x[..., 0] * x[..., 1] + y[..., 0] * y[..., 1], 1.0)
    cross = jnp.where(has_direction, x[..., 0] * y[..., 1] - y[..., 0] * x[..., 1], 0.0)
    norm = jnp.hypot(dot, cross)
    cosine, sine = (dot / norm)[..., None], (cross / norm)[..., None]
    centred = line - line[..., :1, :]
    rotated = jnp.stack(
        [
            cosine * centred[..., 0] - sine * centred[..., 1],
            sine * centred[..., 0] + cosine * centred[..., 1],
        ],
        axis=-1,
    )
    residual = (new - rotated[..., -1, :])[..., None, :]
    fraction = jnp.linspace(0.0, 1.0, line.shape[-2], dtype=line.dtype)[:, None]
    fraction = fraction.reshape((1,) * (line.ndim - 2) + fraction.shape)
    return first[..., None, :] + rotated + fraction * residual
