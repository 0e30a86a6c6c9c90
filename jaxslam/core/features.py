"""Features of one scan: the record, its padding, and how records are put together."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.core.types import Array


class Features(NamedTuple):
    """Features of one scan, of all three kinds, padded to M; robot frame.

    Attributes:
        kind: (M,) int32, `JUNCTION`, `CORNER` or `WALL`, the kinds of landmarks, or
            `FAR_JUNCTION`, which is an end of arcs only.
        xy: (M, 2) [m] position; zero for a wall direction.
        cov: (M, 2, 2) [m^2] covariance of the position.
        direction: (M,) [rad] of a corner: bisector of its free side; of a wall: of its line, in
            [-pi/2, pi/2); 0 for a junction.
        direction_variance: (M,) [rad^2] of a wall's direction.
        descriptor: (M,) clearance [m] of a junction; angle [rad] of the free side of a corner; 0
            for a wall.
        degree: (M,) int32 number of walls that the circle of a junction touches.
        certified: (M,) bool, all of the circle of a junction was seen.
        trusted: (M,) bool, may start a new landmark; the others are only matched with known ones.
        valid: (M,) bool, False marks padding.
        incidence: (M,) [rad] largest angle between a beam and the normal of the wall that it meets,
            at the middle of what is seen of each wall of the feature, 0 to pi / 2; None: not known.
    """

    kind: Array
    xy: Array
    cov: Array
    direction: Array
    direction_variance: Array
    descriptor: Array
    degree: Array
    certified: Array
    trusted: Array
    valid: Array
    incidence: Array | None = None


def zero_padding(features: Features) -> Features:
    """Set every number of the padding to zero, except `kind`."""
    valid = features.valid

    def clear(x: Array) -> Array:
        return jnp.where(valid.reshape(valid.shape + (1,) * (x.ndim - 1)), x, jnp.zeros_like(x))

    return jax.tree.map(clear, features)._replace(kind=features.kind)


def restrict_features(features: Features, wanted: Array) -> Features:
    """Mark as padding the features that are not `wanted` (M,) bool, or hold NaN or infinity."""
    numbers = (
        features.xy,
        features.cov,
        features.direction,
        features.direction_variance,
        features.descriptor,
    )
    for x in numbers if features.incidence is None else (*numbers, features.incidence):
        wanted &= jnp.all(jnp.isfinite(x.reshape(x.shape[0], -1)), axis=1)
    return zero_padding(features._replace(valid=features.valid & wanted))


def concatenate_features(*parts: Features) -> Features:
    """Concatenate features of one scan into one record."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
