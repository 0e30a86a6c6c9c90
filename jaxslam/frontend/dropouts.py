"""Drop-outs: beams that do not return from a wall on which the beams beside them do.

A beam that meets nothing in range does not return; nor does one that is lost on glass, on black
paint, or by chance. The first crosses free space, the second says nothing. What a few beams leave
open between two returns is too narrow for a robot: there they are of the second kind.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import vector_length
from jaxslam.core.types import Array
from jaxslam.frontend.segments import SegmentSpec

MAX_EXTRAPOLATION = 8.0  # most that a third return is beyond two others, in their distance


class FilledScan(NamedTuple):
    """A scan whose drop-outs are filled.

    Attributes:
        scan: (R,) where the returns on either side of a drop-out are of one wall, hits on the line
            between them; elsewhere none, at the range of the nearer of both.
        measured: (R,) bool, the beam returned itself.
        jump: (R,) bool, the wall is interrupted before this beam.
        previous: (R,) int32 last return before this beam, -1 for none.
        following: (R,) int32 first return after it, R for none.
        beyond: (R, 2) [m] ranges of these; where they are beyond more than a drop-out, of the
            beams before and after this one; 0 outside the field of view.
        gap: (R, 2) number of beams to what has this range.
    """

    scan: Scan
    measured: Array
    jump: Array
    previous: Array
    following: Array
    beyond: Array
    gap: Array


def fill_dropouts(lidar: Lidar, spec: SegmentSpec, scan: Scan) -> FilledScan:
    """Find where walls are interrupted, and fill the drop-outs of a scan.

    Beams without a return are a drop-out if the returns on either side leave open less than
    `max_gap` across the beams. Two successive returns that are further apart than `jump_distance`
    are of one wall if the two before predict the second of them, or the two after the first.

    Args:
        lidar: The scanner.
        spec: Parameters of the segmentation.
        scan: One of its scans, as JAX arrays.
    """
    r, hit, count = scan.ranges, scan.hit, scan.ranges.size
    beam = jnp.arange(count, dtype=jnp.int32)
    previous, following = _nearest_returns(hit)
    padded = jnp.pad(r, 1, constant_values=1.0)
    before, after = padded[previous + 1], padded[following + 1]
    back, on = beam - previous, following - beam  # numbers of beams
    # The return before that before.
    at = jnp.maximum(previous, 0)
    second, base = before[at], back[at]
    has_second = (previous >= 0) & (base <= at)

    angle = jnp.asarray(_angles(lidar), r.dtype)
    narrow = (back == 1) | (jnp.minimum(r, before) * angle[back] < spec.max_gap)
    narrow &= hit & (previous >= 0)
    change = jnp.abs(r - before)
    chord = 4.0 * np.sin(0.5 * _angles(lidar)) ** 2
    wide = change**2 + r * before * jnp.asarray(chord, r.dtype)[back] > spec.jump_distance**2
    of_wall = partial(_is_predicted, lidar, spec, change=change, ahead=back)
    forward = of_wall(second, before, r, base) & has_second
    backward = of_wall(after, r, before, on) & (following < count)
    joined = narrow & (~wide | forward | backward)

    next_narrow, next_joined = jnp.pad(jnp.stack([narrow, joined]), ((0, 0), (0, 1)))[:, following]
    filled = ~hit & next_joined
    sine = jnp.asarray(np.sin(_angles(lidar)), r.dtype)
    inverse = sine[on] / before + sine[back] / after
    on_line = sine[jnp.minimum(back + on, count)] / jnp.where(filled, inverse, 1.0)
    ranges = jnp.where(~hit & next_narrow, jnp.minimum(before, after), r)
    ranges = jnp.where(filled, on_line, ranges)

    neighbours = jnp.stack([jnp.pad(r[:-1], (1, 0)), jnp.pad(r[1:], (0, 1))], axis=1)
    known = jnp.stack([narrow, next_narrow], axis=1)
    gap = jnp.where(known, jnp.stack([back, on], axis=1), 1)
    return FilledScan(
        scan=Scan(ranges, hit | filled),
        measured=hit,
        jump=(~filled & ~joined).at[0].set(True),
        previous=previous,
        following=following,
        beyond=jnp.where(known, jnp.stack([before, after], axis=1), neighbours),
        gap=gap,
    )


def _angles(lidar: Lidar) -> np.ndarray:
    """Angles [rad] of 0 to R + 1 beams, a quarter turn at most: no larger one matters."""
    return np.minimum(np.arange(lidar.num_beams + 2) * lidar.angle_increment, 0.5 * np.pi)


def _nearest_returns(hit: Array) -> tuple[Array, Array]:
    """Number (R,) int32 of the last return before each beam, and of the first after it.

    Args:
        hit: (R,) bool.

    Returns:
        -1 where there is none before it, R where there is none after it.
    """
    beam = jnp.arange(hit.size, dtype=jnp.int32)

    def pass_beam(last: Array, here: tuple[Array, Array]) -> tuple[Array, Array]:
        own, is_hit = here
        return jnp.where(is_hit, own, last), last

    # From both ends in one loop; from the last beam on they are counted backwards.
    both = beam, jnp.stack([hit, hit[::-1]], axis=1)
    last = lax.scan(pass_beam, jnp.full(2, -1, jnp.int32), both)[1]
    return last[:, 0], hit.size - 1 - last[::-1, 1]


def _is_predicted(
    lidar: Lidar,
    spec: SegmentSpec,
    first: Array,
    second: Array,
    third: Array,
    base: Array,
    *,
    ahead: Array,
    change: Array,
) -> Array:
    """Whether two returns predict a third (R,), within noise and roughness.

    On a straight wall, however grazing, 1 / r is a sinusoid of the bearing. With b beams from the
    first return to the second and a beams to the third:

        1 / third = (sin((a + b) step) / second - sin(a step) / first) / sin(b step)

    With k = a / b, ranges of noise s predict with s sqrt(1 + k^2 + (1 + k)^2); twice that and a
    part of the change of the range, as a far wall may bend a little, are allowed. An offset of the
    wall, which is rough, changes a range by 1 / cos(incidence) times as much.

    Args:
        lidar: The scanner.
        spec: Parameters of the segmentation.
        first: (R,) [m].
        second: (R,) [m].
        third: (R,) [m].
        base: (R,) int32 number b of beams.
        ahead: (R,) int32 number a of beams.
        change: (R,) [m] by which the range changes from the second to the third.
    """
    sine = jnp.asarray(np.sin(_angles(lidar)), third.dtype)
    both = jnp.minimum(ahead + base, lidar.num_beams)
    inverse = sine[both] / second - sine[ahead] / first
    predicted = jnp.where(inverse > 0.0, sine[base] / jnp.maximum(inverse, 1e-8), jnp.inf)
    beams = jnp.maximum(base, 1).astype(third.dtype)
    ratio = ahead.astype(third.dtype) / beams
    width = second * beams * lidar.angle_increment
    slant = vector_length(second - first, width) / width
    noise = 2.04 * lidar.range_std * jnp.sqrt(1.0 + ratio**2 + (1.0 + ratio) ** 2)
    allowed = noise + 0.05 * change + (1.0 + ratio) * spec.roughness_std * slant
    return (jnp.abs(predicted - third) < allowed) & (ratio <= MAX_EXTRAPOLATION)
