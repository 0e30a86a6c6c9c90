"""A scan takes time: beams of a scanner whose robot moves are of different poses.

The mirror turns once in `Scanner.turn_time`, and a scan is put together of `Scanner.num_turns`
turns, so beam i of R is measured at

    t_i = turn_time (increment i / 2 pi  +  i mod num_turns)      less the mean of all

from the pose at that time. Within the milliseconds of a scan the distance to one surface changes in
proportion to time: what the beams meet at the first time and at the last one is enough.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.se2 import compose, relative
from jaxslam.core.types import Array
from jaxslam.simulation.scanners import FULL_CIRCLE, Scanner

Seen = tuple[Array, Array, Array]
"""Distance [m], infinite where nothing is met, incidence [rad] and surface of each beam (R,)."""


def beam_times(scanner: Scanner) -> np.ndarray:
    """Times (R,) [s] of the beams since the middle of the scan; all 0 without `turn_time`."""
    number = np.arange(scanner.num_beams)
    turns = scanner.angle_increment * number / FULL_CIRCLE + number % scanner.num_turns
    return (scanner.turn_time or 0.0) * (turns - turns.mean())


def velocities(poses: Array, times: Array) -> Array:
    """Velocities (T, 3) [m/s, m/s, rad/s], robot frame, of a robot that is at poses (T, 3).

    Each is that to the next pose, at times (T,) [s]; the last is that before.
    """
    step = jax.vmap(relative)(poses[:-1], poses[1:])
    step /= jnp.maximum(jnp.diff(times), 1e-3)[:, None]
    return jnp.concatenate([step, step[-1:]]) if len(step) else jnp.zeros_like(poses)


def look_in_motion(
    look: Callable[[Array], Seen], scanner: Scanner, pose: Array, velocity: Array
) -> Seen:
    """What the beams of a scan meet, each at its own time.

    Args:
        look: What they meet from a pose (3,).
        scanner: With the time of its turns.
        pose: (3,) [m, m, rad] in the middle of the scan.
        velocity: (3,) [m/s, m/s, rad/s] of the scanner in its own frame.
    """
    times = beam_times(scanner)
    first, last = times.min(), times.max()
    ends = jnp.stack([compose(pose, first * velocity), compose(pose, last * velocity)])
    distance, incidence, surface = lax.map(look, ends)
    share = jnp.asarray((times - first) / (last - first), pose.dtype)
    early = share < 0.5
    same = (surface[0] == surface[1]) & jnp.isfinite(distance).all(axis=0)
    change = jnp.where(same, distance[1], 0.0) - jnp.where(same, distance[0], 0.0)
    nearer = jnp.where(early, distance[0], distance[1])
    return (
        jnp.where(same, distance[0] + share * change, nearer),
        jnp.where(early, incidence[0], incidence[1]),
        jnp.where(early, surface[0], surface[1]),
    )
