"""Belief (state) of EKF-SLAM: a Gaussian over pose and landmarks, and track management."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.covariance import Postponed, settle
from jaxslam.nodes import Nodes
from jaxslam.types import NODE, Array, expect, expect_covariance


class Belief(NamedTuple):
    """Gaussian belief over pose and landmarks, D = 3 + 2 L, and the track of each landmark.

    The covariance is kept in blocks: a prediction changes the first two only.

    A landmark's two numbers in its slot are its position [m] (junction, corner), or the direction
    of a wall [rad] and 0; world frame.

    Attributes:
        mean: (D,) pose [m, m, rad], then the slots.
        anchor: (D,) pose as last predicted, slots as first estimated: where "first_estimates"
            linearises.
        pose_cov: (3, 3) covariance of the pose.
        cross_cov: (3, 2 L) covariance of pose and slots.
        map_cov: (2 L, 2 L) covariance of the slots; dense or deferred.
        seen: (L,) int32 number of observations of the landmark; 0 marks a free slot.
        last: (L,) int32 step of its last observation.
        missed: (L,) int32 consecutive missed detections: steps at which it should have been
            observed and was not.
        looks: (L,) int32 consecutive matches that are not accepted yet, while matches of
            landmarks are verified.
        kind: (L,) int32 `NODE`, `CORNER` or `WALL`.
        id: (L,) int32 ID of the landmark, never reused.
        direction: (L,) [rad] world frame, bisector of the free side of a corner.
        shape: (L,) descriptor: clearance [m] of a junction, angle of the free side [rad] of a
            corner.
        step: () int32 number of the step.
        next_id: () int32 ID of the next landmark.
    """

    mean: Array
    anchor: Array
    pose_cov: Array
    cross_cov: Array
    map_cov: Array | Postponed
    seen: Array
    last: Array
    missed: Array
    looks: Array
    kind: Array
    id: Array
    direction: Array
    shape: Array
    step: Array
    next_id: Array

    @property
    def pose(self) -> Array:
        """Mean pose (3,) [m, m, rad], world frame."""
        return self.mean[..., :3]

    @property
    def cov(self) -> Array:
        """Covariance (D, D) of pose and slots, assembled from its blocks."""
        cross_cov, map_cov = jnp.swapaxes(self.cross_cov, -1, -2), settle(self.map_cov)
        upper = jnp.concatenate([self.pose_cov, self.cross_cov], axis=-1)
        lower = jnp.concatenate([cross_cov, map_cov], axis=-1)
        return jnp.concatenate([upper, lower], axis=-2)

    @property
    def places(self) -> Array:
        """Slots (L, 2) of the mean: position [m], or direction of a wall [rad] and 0; world."""
        return self.mean[..., 3:].reshape(self.mean.shape[:-1] + (-1, 2))


def initial(pose: Array, *, landmarks: int, cov: Array | None = None) -> Belief:
    """Belief with an initial pose and an empty map.

    Args:
        pose: (3,) [m, m, rad] world frame.
        landmarks: L, slots of the map.
        cov: (3, 3) covariance of the pose; zero by default: the first pose defines the map frame.

    Raises:
        ValueError: The covariance is not symmetric and positive semi-definite.
    """
    size = 3 + 2 * landmarks
    dtype = jnp.result_type(pose)
    if cov is not None:
        expect("cov", cov, (3, 3), jnp.floating)
        expect_covariance("cov", cov, definite=False)
    zeros = jnp.zeros(landmarks, jnp.int32)
    mean = jnp.zeros(size, dtype).at[:3].set(pose)
    return Belief(
        mean=mean,
        anchor=mean,
        pose_cov=jnp.zeros((3, 3), dtype) if cov is None else jnp.asarray(cov, dtype),
        cross_cov=jnp.zeros((3, size - 3), dtype),
        map_cov=jnp.zeros((size - 3, size - 3), dtype),
        seen=zeros,
        last=zeros,
        missed=zeros,
        looks=zeros,
        kind=zeros,
        id=zeros,
        direction=jnp.zeros(landmarks, dtype),
        shape=jnp.zeros(landmarks, dtype),
        step=jnp.zeros((), jnp.int32),
        next_id=jnp.zeros((), jnp.int32),
    )


def grown(belief: Belief, landmarks: int) -> Belief:
    """The belief with more slots, `landmarks` in all; the added ones are free.

    Its covariance must be dense.
    """
    blank = initial(belief.pose, landmarks=landmarks)

    def put_at_start(old: Array, new: Array) -> Array:
        return new.at[tuple(slice(n) for n in old.shape)].set(old)

    return jax.tree.map(put_at_start, belief, blank)


def know(belief: Belief, places: Array, cov: Array, kind: int = NODE) -> Belief:
    """Add landmarks with prior positions to an empty map, in the first slots.

    Args:
        belief: Without landmarks; its covariance must be dense.
        places: (K, 2) mean positions [m], world frame; K <= L.
        cov: (K, 2, 2) covariances [m^2] of the positions, which are independent.
        kind: Kind of all of them, `NODE` or `CORNER`.

    Raises:
        ValueError: A covariance is not symmetric and positive definite, or shapes do not fit.
    """
    expect("places", places, ("K", 2), jnp.floating)
    count, size = places.shape[0], belief.seen.size
    expect("cov", cov, (count, 2, 2), jnp.floating)
    expect_covariance("cov", cov)
    if count > size:
        raise ValueError(f"{count} positions for a map of {size} landmarks")
    index = jnp.arange(count, dtype=jnp.int32)
    mean = belief.mean.at[3 : 3 + 2 * count].set(places.reshape(-1))
    map_cov = belief.map_cov.reshape(size, 2, size, 2).at[index, :, index].set(cov)
    return belief._replace(
        mean=mean,
        anchor=mean,
        map_cov=map_cov.reshape(belief.map_cov.shape),
        seen=belief.seen.at[:count].set(1),
        kind=belief.kind.at[:count].set(kind),
        id=belief.id.at[:count].set(index),
        next_id=jnp.maximum(belief.next_id, jnp.int32(count)),
    )


def note(belief: Belief, nodes: Nodes, slot: Array) -> Belief:
    """Record the observations of a scan in the tracks of the matched landmarks.

    Args:
        belief: Belief.
        nodes: Features of the scan.
        slot: (M,) int32 slot of each feature's landmark; L, where it has none, is dropped.
    """
    return belief._replace(
        seen=belief.seen.at[slot].add(1, mode="drop"),
        last=belief.last.at[slot].set(belief.step, mode="drop"),
        missed=belief.missed.at[slot].set(0, mode="drop"),
        shape=belief.shape.at[slot].set(nodes.shape, mode="drop"),
    )


def worth(belief: Belief, confirmed: Array, *, idle: int) -> Array:
    """Eviction cost of each slot (L,): the slot of least cost is reused first.

    It is zero for free slots, and infinite for confirmed landmarks and those observed within the
    last `idle` steps. For the other candidates it orders by the number of observations, then by
    the step of the last one:

        cost = seen + 1 - age / (1 + max(step, age)),      age = step - last

    Args:
        belief: Belief.
        confirmed: (L,) bool, landmarks that are confirmed.
        idle: Largest age [steps] at which a candidate is kept.
    """
    dtype = belief.mean.dtype
    age = belief.step - belief.last
    relative_age = age.astype(dtype) / (1 + jnp.maximum(belief.step, age)).astype(dtype)
    cost = belief.seen.astype(dtype) + 1.0 - relative_age
    cost = jnp.where(confirmed | (age <= idle), jnp.inf, cost)
    return jnp.where(belief.seen == 0, 0.0, cost)


def forget(belief: Belief, gone: Array) -> Belief:
    """Prune landmarks: free the slots (L,) bool; their values are overwritten on reuse."""
    return belief._replace(seen=jnp.where(gone, 0, belief.seen))
