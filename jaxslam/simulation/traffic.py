"""What moves in a world while the robot drives: people and carts, doors, furniture."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core import polylines
from jaxslam.core.types import AnyArray, Array, Key, as_float64

WALKWAY_SPACING = 0.25  # [m] between points of a walkway
NUM_STATES = 64  # states of a door that follow each other, then from the first again
CYCLE = 20.0  # [s] in which a person walks and stands once


class Traffic(NamedTuple):
    """How many people walk, how doors and furniture change; numbers, traced under jit.

    Attributes:
        people: Number of people that walk to and fro on the walkway, at most the number of slots.
        speed: [m / s] mean speed of those that walk; each has one of its own, up to 30 % off.
        standing: [-] share of the time in which each stands.
        carts: [-] share of them that push a cart, which is wider.
        distance: [m] that they keep from the scanner, from their edge: they step aside.
        closed: [-] share of the time in which each door is closed; open doors are not seen.
        door_period: [s] after which a door may change.
        moved_at: [s] time at which furniture is moved, infinite for never.
    """

    people: Any = 0.0
    speed: Any = 1.0
    standing: Any = 0.3
    carts: Any = 0.0
    distance: Any = 0.3
    closed: Any = 0.0
    door_period: Any = 30.0
    moved_at: Any = np.inf


class Movers(NamedTuple):
    """What may move in a world; shapes are fixed, all may be empty.

    Attributes:
        people: (K,) int32 numbers of the people that there may be: 0, 1, ...
        walkway: (N, 2) [m] points about `WALKWAY_SPACING` apart on which they walk to and fro.
        doors: (D, 4) [m] ends of closed doors.
        before: (P, 4) [m] ends of the walls of furniture before it is moved.
        after: (P, 4) [m] the same afterwards.
    """

    people: AnyArray
    walkway: AnyArray
    doors: AnyArray
    before: AnyArray
    after: AnyArray


class Crowd(NamedTuple):
    """What is drawn once a drive: K people on a walkway, and the states of the doors.

    Attributes:
        start: (K,) [m] along the walkway at time 0.
        speed: (K,) [m / s], negative for those that begin backwards.
        phase: (K,) [s] of walking and standing.
        aside: (K,) [m] to the left of the walkway.
        radius: (K,) [m]; 0 for slots that are not used.
        states: (D, NUM_STATES) uniform numbers; a door is closed where one is below the share.
        door_phase: (D,) [-] of its period.
    """

    start: Array
    speed: Array
    phase: Array
    aside: Array
    radius: Array
    states: Array
    door_phase: Array


PERSON_RADIUS = 0.15, 0.25  # [m] smallest and largest
CART_RADIUS = 0.4  # [m]
MAX_ASIDE = 0.3  # [m] from the walkway


def walkway(path: Any) -> np.ndarray:
    """Points (N, 2) [m] at even distances, about `WALKWAY_SPACING`, along a path (K, 2) [m].

    Raises:
        ValueError: The path has another shape, or no length.
    """
    points = as_float64("path", path, ("K", 2))
    length = float(polylines.length(points))
    if not length > 0.0:
        raise ValueError("path has no length; people walk along it")
    return polylines.resample(points, max(2, round(length / WALKWAY_SPACING) + 1))


def make_crowd(key: Key, traffic: Traffic, movers: Movers) -> Crowd:
    """Draw K people, of whom the first `traffic.people` are there, and states of doors.

    Person k is the same whatever their number.
    """
    points, numbers = jnp.asarray(movers.walkway), jnp.asarray(movers.people)
    of_people, of_states, of_phases = jax.random.split(key, 3)

    def person(number: Array) -> Array:
        return jax.random.uniform(jax.random.fold_in(of_people, number), (6,), points.dtype)

    start, pace, phase, aside, cart, wide = jax.vmap(person, out_axes=1)(numbers)
    low, high = PERSON_RADIUS
    radius = jnp.where(cart < traffic.carts, CART_RADIUS, low + (high - low) * wide)
    signed = 2.0 * pace - 1.0  # uniform in -1 to 1: its sign is the direction
    speed = traffic.speed * jnp.sign(signed) * (0.7 + 0.6 * jnp.abs(signed))
    return Crowd(
        start=2.0 * _length(points) * start,
        speed=speed,
        phase=CYCLE * phase,
        aside=MAX_ASIDE * (2.0 * aside - 1.0),
        radius=jnp.where(numbers.astype(points.dtype) < traffic.people, radius, 0.0),
        states=jax.random.uniform(of_states, (len(movers.doors), NUM_STATES), points.dtype),
        door_phase=jax.random.uniform(of_phases, (len(movers.doors),), points.dtype),
    )


def _length(points: Array) -> Array:
    """Length () [m] of a walkway (N, 2), whose points are at even distances along it."""
    return jnp.sum(jnp.hypot(*jnp.diff(points, axis=0).T))


def walked(crowd: Crowd, traffic: Traffic, time: Array) -> Array:
    """Distance (K,) [m] along which each person has walked at a time () [s]; it stands between."""
    walks = CYCLE * (1.0 - traffic.standing)
    of_cycle = jnp.mod(time + crowd.phase, CYCLE)
    cycles = jnp.floor((time + crowd.phase) / CYCLE)
    return crowd.speed * (cycles * walks + jnp.minimum(of_cycle, walks))


def people_at(
    crowd: Crowd, traffic: Traffic, movers: Movers, time: Array, scanner: Array
) -> tuple[Array, Array]:
    """Centres (K, 2) [m] and radii (K,) [m] of people at a time () [s]; radius 0: nobody.

    They walk to the end of the walkway and back, and keep away from the scanner (2,) [m].
    """
    points = jnp.asarray(movers.walkway)
    length = _length(points)
    along = jnp.mod(crowd.start + walked(crowd, traffic, time), 2.0 * length)
    along = length - jnp.abs(along - length)  # to and fro
    position = along / length * (len(points) - 1)
    first = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, len(points) - 2)
    step = points[first + 1] - points[first]
    across = jnp.stack([-step[:, 1], step[:, 0]], axis=1)
    across = across / jnp.maximum(jnp.hypot(step[:, 0], step[:, 1]), 1e-9)[:, None]
    share = (position - first.astype(position.dtype))[:, None]
    centre = points[first] + share * step + crowd.aside[:, None] * across
    gap = centre - scanner[None]
    far = jnp.hypot(gap[:, 0], gap[:, 1])
    least = crowd.radius + traffic.distance
    direction = jnp.where((far > 1e-6)[:, None], gap / jnp.maximum(far, 1e-6)[:, None], across)
    aside = scanner[None] + jnp.maximum(far, least)[:, None] * direction
    return aside, crowd.radius


def moved_walls(
    crowd: Crowd, traffic: Traffic, movers: Movers, time: Array, scanner: Array
) -> Array:
    """Walls (D + P, 4) [m] of doors and furniture at a time () [s]; of no length where none is.

    A door is open while the scanner (2,) [m] is within a metre of it.
    """
    doors = jnp.asarray(movers.doors)
    state = jnp.floor(time / traffic.door_period + crowd.door_phase).astype(jnp.int32)
    drawn = jnp.take_along_axis(crowd.states, jnp.mod(state, NUM_STATES)[:, None], axis=1)[:, 0]
    middle = (doors[:, :2] + doors[:, 2:]) / 2
    half = jnp.hypot(*(doors[:, 2:] - doors[:, :2]).T) / 2
    near = jnp.hypot(*(middle - scanner[None]).T) < half + 1.0
    is_closed = (drawn < traffic.closed) & ~near
    closed = jnp.where(is_closed[:, None], doors, jnp.concatenate([middle, middle], axis=1))
    before, after = jnp.asarray(movers.before), jnp.asarray(movers.after)
    pieces = jnp.where(time < traffic.moved_at, before, after)
    return jnp.concatenate([closed, pieces])
