"""The belief of EKF-SLAM: a Gaussian over pose and landmarks, and the life of each landmark."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.covariance import Postponed, settle
from jaxslam.nodes import Nodes
from jaxslam.types import NODE, Array, expect, expect_covariance


class Belief(NamedTuple):
    """Gaussian belief over pose and landmarks, D = 3 + 2 L, and the life of each landmark.

    The covariance is kept in blocks: a motion changes the first two only.
    """

    mean: Array  # (D,) pose [m, m, rad], then the slots
    anchor: Array  # (D,) pose as last predicted, slots as first estimated
    pose_cov: Array  # (3, 3)
    cross_cov: Array  # (3, 2 L) of pose and slots
    map_cov: Array | Postponed  # (2 L, 2 L)
    seen: Array  # (L,) int32 how often the landmark was seen; 0 marks a free slot
    last: Array  # (L,) int32 step it was last seen
    missed: Array  # (L,) int32 steps in a row that it should have been seen and was not
    looks: Array  # (L,) int32 times in a row that it was met again and not yet believed
    kind: Array  # (L,) int32
    id: Array  # (L,) int32, never reused
    direction: Array  # (L,) [rad] world frame, of a corner's free side
    shape: Array  # (L,) clearance [m] of a node, angle of the free side [rad] of a corner
    step: Array  # () int32
    next_id: Array  # () int32

    @property
    def pose(self) -> Array:
        """Mean pose (3,), world frame."""
        return self.mean[..., :3]

    @property
    def cov(self) -> Array:
        """Covariance (D, D) of pose and slots, put together."""
        top = jnp.concatenate([self.pose_cov, self.cross_cov], axis=-1)
        low = jnp.concatenate([jnp.swapaxes(self.cross_cov, -1, -2), settle(self.map_cov)], axis=-1)
        return jnp.concatenate([top, low], axis=-2)

    @property
    def places(self) -> Array:
        """Slots (L, 2) of the mean."""
        return self.mean[..., 3:].reshape(self.mean.shape[:-1] + (-1, 2))


def initial(pose: Array, *, landmarks: int, cov: Array | None = None) -> Belief:
    """Belief of a robot that knows its pose (3,) and no landmark.

    Args:
        pose: World frame.
        landmarks: L, slots of the map.
        cov: (3, 3) covariance of the pose; zero by default, as the map has no other origin.

    Raises:
        ValueError: The covariance is not symmetric and positive semi-definite.
    """
    size = 3 + 2 * landmarks
    dtype = jnp.result_type(pose)
    if cov is not None:
        expect("cov", cov, (3, 3), jnp.floating)
        expect_covariance("cov", cov, definite=False)
    whole = jnp.zeros(landmarks, jnp.int32)
    mean = jnp.zeros(size, dtype).at[:3].set(pose)
    return Belief(
        mean=mean,
        anchor=mean,
        pose_cov=jnp.zeros((3, 3), dtype) if cov is None else jnp.asarray(cov, dtype),
        cross_cov=jnp.zeros((3, size - 3), dtype),
        map_cov=jnp.zeros((size - 3, size - 3), dtype),
        seen=whole,
        last=whole,
        missed=whole,
        looks=whole,
        kind=whole,
        id=whole,
        direction=jnp.zeros(landmarks, dtype),
        shape=jnp.zeros(landmarks, dtype),
        step=jnp.zeros((), jnp.int32),
        next_id=jnp.zeros((), jnp.int32),
    )


def grown(belief: Belief, landmarks: int) -> Belief:
    """The belief with more slots, L of them, free where there was none."""
    blank = initial(belief.pose, landmarks=landmarks)
    put = lambda old, new: new.at[tuple(slice(n) for n in old.shape)].set(old)
    return jax.tree.map(put, belief, blank)


def know(belief: Belief, places: Array, cov: Array, kind: int = NODE) -> Belief:
    """Give an empty map landmarks that are known beforehand, in the first slots.

    Args:
        belief: Without landmarks.
        places: (K, 2) where they are, world frame; K <= L.
        cov: (K, 2, 2) their covariances.
        kind: What they are, `NODE` or `CORNER`.

    Raises:
        ValueError: A covariance is not symmetric and positive definite, or shapes do not fit.
    """
    expect("places", places, ("K", 2), jnp.floating)
    count, size = places.shape[0], belief.seen.size
    expect("cov", cov, (count, 2, 2), jnp.floating)
    expect_covariance("cov", cov)
    if count > size:
        raise ValueError(f"{count} places for a map of {size} landmarks")
    index = jnp.arange(count, dtype=jnp.int32)
    mean = belief.mean.at[3 : 3 + 2 * count].set(places.reshape(-1))
    blocks = belief.map_cov.reshape(size, 2, size, 2).at[index, :, index].set(cov)
    return belief._replace(
        mean=mean,
        anchor=mean,
        map_cov=blocks.reshape(belief.map_cov.shape),
        seen=belief.seen.at[:count].set(1),
        kind=belief.kind.at[:count].set(kind),
        id=belief.id.at[:count].set(index),
        next_id=jnp.maximum(belief.next_id, jnp.int32(count)),
    )


def note(belief: Belief, nodes: Nodes, slot: Array) -> Belief:
    """Count the sighting of the matched slots (M,); L is nowhere."""
    return belief._replace(
        seen=belief.seen.at[slot].add(1, mode="drop"),
        last=belief.last.at[slot].set(belief.step, mode="drop"),
        missed=belief.missed.at[slot].set(0, mode="drop"),
        shape=belief.shape.at[slot].set(nodes.shape, mode="drop"),
    )


def worth(belief: Belief, confirmed: Array, *, idle: int) -> Array:
    """What is lost with each slot (L,): nothing with free ones, all with confirmed landmarks.

    A candidate may go when it was not seen for more than `idle` steps: the least seen first, then
    the longest unseen.

    Args:
        belief: Belief.
        confirmed: (L,) bool, landmarks that count.
        idle: Steps.
    """
    age = belief.step - belief.last
    real = lambda x: x.astype(belief.mean.dtype)
    value = real(belief.seen) + 1.0 - real(age) / real(1 + jnp.maximum(belief.step, age))
    value = jnp.where(confirmed | (age <= idle), jnp.inf, value)
    return jnp.where(belief.seen == 0, 0.0, value)


def forget(belief: Belief, gone: Array) -> Belief:
    """Free the slots (L,) bool; what they held is overwritten when they are used again."""
    return belief._replace(seen=jnp.where(gone, 0, belief.seen))
