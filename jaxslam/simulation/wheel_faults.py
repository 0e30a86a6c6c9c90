"""What goes wrong with a robot's wheels, its odometry and its scans on a drive."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.types import Array, Key

PATCH = 2.0  # [m] side of the squares of the floor that are carpet or not


class WheelFaults(NamedTuple):
    """How often wheels, odometry and scans fail; numbers, traced under jit, never by default.

    Attributes:
        slip: [-] probability, for each wheel and motion between two scans, that the wheel slips.
        slip_share: [-] scale of the share of its motion that a wheel that slips loses: that of the
            modulus of a Student's t with two degrees of freedom, at most 1.
        carpet: [-] share of the floor that is carpet.
        carpet_turn: [rad / m] by which a robot is turned on carpet, to one side in each patch.
        lost: [-] probability, for each scan, that the odometry fails.
        lost_scans: [-] mean number of scans for which it does, at least 1.
        latched: [-] share of failures in which it repeats the last increment; in others it stands.
        dropped: [-] probability that a scan is lost.
        carried: [-] probability that the robot is carried once on the drive, unseen by odometry.
        carry: [m] further along its path it is put down, facing along it.
    """

    slip: Any = 0.0
    slip_share: Any = 0.2
    carpet: Any = 0.0
    carpet_turn: Any = 0.02
    lost: Any = 0.0
    lost_scans: Any = 4.0
    latched: Any = 0.5
    dropped: Any = 0.0
    carried: Any = 0.0
    carry: Any = 3.0


def can_fail(faults: WheelFaults) -> bool:
    """Whether the odometry may differ from the motion by more than its noise."""
    causes = faults.slip, faults.carpet, faults.lost, faults.carried
    return any(float(x) > 0.0 for x in causes)


class FaultDraws(NamedTuple):
    """What is drawn once a drive.

    Attributes:
        slip: (T - 1, 2) share of its motion that each wheel loses, left and right.
        carpet: Key of the patches of the floor.
        carried_at: () int32 motion before which the robot is carried, -1 for never.
    """

    slip: Array
    carpet: Key
    carried_at: Array


def draw_faults(key: Key, faults: WheelFaults, num_scans: int, dtype: Any) -> FaultDraws:
    """Draw the faults of a drive of T scans."""
    of_slip, of_share, of_carpet, of_carried, of_time = jax.random.split(key, 5)
    shape = (num_scans - 1, 2)
    slip = slip_shares(
        faults,
        jax.random.uniform(of_slip, shape, dtype),
        jax.random.uniform(of_share, shape, dtype, maxval=0.9999),
    )
    happens = jax.random.uniform(of_carried, (), dtype) < faults.carried
    at = jax.random.randint(of_time, (), 0, max(num_scans - 1, 1), jnp.int32)
    return FaultDraws(
        slip=slip,
        carpet=of_carpet,
        carried_at=jnp.where(happens, at, -1),
    )


def slip_shares(faults: WheelFaults, happens: Array, size: Array) -> Array:
    """Share (...) of its motion that a wheel loses, by two uniform draws (...) in [0, 1)."""
    # The square of a t with two degrees of freedom has the quantile 2 u^2 / (1 - u^2).
    share = faults.slip_share * jnp.sqrt(2.0 * size**2 / (1.0 - size**2))
    return jnp.where(happens < faults.slip, jnp.minimum(share, 1.0), 0.0)


def slipped(
    faults: WheelFaults, draws: FaultDraws, slip: Array, base: float, pose: Array, motion: Array
) -> Array:
    """True motion (3,) of a robot whose wheels slip, on carpet or not.

    Args:
        faults: How often wheels fail.
        draws: Of this drive.
        slip: (2,) share of its motion that each wheel loses now.
        base: [m] distance between the wheels.
        pose: (3,) [m, m, rad] before the motion.
        motion: (3,) [m, m, rad] without slip.
    """
    distance = jnp.hypot(motion[0], motion[1]) * jnp.where(motion[0] < 0.0, -1.0, 1.0)
    kept = 1.0 - jnp.mean(slip)
    # The wheel that slips stays behind: the robot turns to its side.
    turn = kept * motion[2] + (slip[0] - slip[1]) * distance / base
    cell = jnp.floor(pose[:2] / PATCH).astype(jnp.int32)
    own = jax.random.fold_in(jax.random.fold_in(draws.carpet, cell[0]), cell[1])
    drawn, side = jax.random.uniform(own, (2,), motion.dtype)
    is_carpet = drawn < faults.carpet
    turn += jnp.where(is_carpet, jnp.where(side < 0.5, -1.0, 1.0), 0.0) * (
        faults.carpet_turn * jnp.abs(distance)
    )
    return jnp.append(kept * motion[:2], turn)


def carry(
    faults: WheelFaults, is_now: Array, path: Array, index: Array, pose: Array
) -> tuple[Array, Array]:
    """Pose (3,) and path index () of a robot that is carried along its path (N, 2) now, or not."""
    step = jnp.hypot(*jnp.diff(path, axis=0).T)
    along = jnp.concatenate([jnp.zeros_like(step[:1]), jnp.cumsum(step)])
    wanted = jnp.searchsorted(along, along[index] + faults.carry).astype(index.dtype)
    there = jnp.minimum(wanted, len(path) - 2)
    ahead = path[there + 1] - path[there]
    put = jnp.append(path[there], jnp.arctan2(ahead[1], ahead[0]))
    return jnp.where(is_now, put, pose), jnp.where(is_now, there, index)


def fail_odometry(key: Key, faults: WheelFaults, odometry: Array) -> Array:
    """Increments (T, 3) as an odometry reports them that fails now and then.

    While it fails it repeats its last increment, or reports none.
    """
    return fail_as_drawn(draw_failures(key, len(odometry), odometry.dtype), faults, odometry)


def draw_failures(key: Key, num_scans: int, dtype: Any) -> Array:
    """Uniform draws (T, 3): whether odometry fails at a scan, recovers, and how it fails."""
    keys = jax.random.split(key, 3)
    return jnp.stack([jax.random.uniform(own, (num_scans,), dtype) for own in keys], axis=1)


def fail_as_drawn(draws: Array, faults: WheelFaults, odometry: Array) -> Array:
    """`fail_odometry` by uniform draws (T, 3), those of `draw_failures`."""
    starts = draws[:, 0] < faults.lost
    ends = draws[:, 1] * faults.lost_scans < 1.0
    latches = draws[:, 2] < faults.latched

    def body(state: tuple[Array, Array], now: Any) -> tuple[tuple[Array, Array], Array]:
        failing, repeated = state
        increment, starts, ends, latches = now
        begins = starts & ~failing
        repeated = jnp.where(begins & ~latches, 0.0, repeated)
        failing |= begins
        reported = jnp.where(failing, repeated, increment)
        return (failing & ~ends, jnp.where(failing & ~ends, repeated, increment)), reported

    # A failure that has ended leaves the true increment to be repeated by the next one.
    state = jnp.zeros((), bool), jnp.zeros_like(odometry[0])
    return lax.scan(body, state, (odometry, starts, ends, latches))[1]


def keeps_scan(key: Key, faults: WheelFaults, num_scans: int, dtype: Any) -> Array:
    """Which of T scans are not lost (T,) bool."""
    return jax.random.uniform(key, (num_scans,), dtype) >= faults.dropped
