"""Belief (state) of EKF-SLAM: a Gaussian over pose and landmarks, and track management."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.core.arguments import as_float, check_covariance
from jaxslam.core.features import Features
from jaxslam.core.types import CORNER, JUNCTION, Array
from jaxslam.filtering.adaptation import Adaptation
from jaxslam.filtering.covariance import DeferredCovariance, flush
from jaxslam.filtering.odometry_bias import OdometryBias


class Belief(NamedTuple):
    """Gaussian belief over pose and landmarks, D = 3 + 2 L, and the track of each landmark.

    The covariance is kept in blocks: a prediction changes the first two only.

    A landmark's two numbers in its slot are its position [m] (junction, corner), or the direction
    of a wall [rad] and 0; map frame.

    Attributes:
        mean: (D,) pose [m, m, rad], then the slots.
        first_estimate: (D,) pose as last predicted, slots as first estimated: where the
            linearisation "first_estimates" takes the Jacobians.
        pose_cov: (3, 3) covariance of the pose.
        cross_cov: (3, 2 L) covariance of pose and slots.
        map_cov: (2 L, 2 L) covariance of the slots; dense or deferred.
        num_seen: (L,) int32 number of observations of the landmark; 0 marks a free slot.
        last_seen: (L,) int32 step of its last observation.
        num_missed: (L,) int32 consecutive missed detections: steps at which it should have been
            observed and was not.
        num_pending: (L,) int32 consecutive scans with a match that was not accepted yet, while
            matches are verified.
        kind: (L,) int32 `JUNCTION`, `CORNER` or `WALL`.
        id: (L,) int32 ID of the landmark, never reused.
        direction: (L,) [rad] map frame, bisector of the free side of a corner.
        descriptor: (L,) descriptor: clearance [m] of a junction, angle of the free side [rad] of a
            corner.
        step: () int32 number of the step.
        next_id: () int32 ID of the next landmark.
        bias: Biases of odometry as states; None: it has none (`odometry_bias`).
        adaptation: Scales of Q and R that adapt; None: they stay (`adaptation`).
    """

    mean: Array
    first_estimate: Array
    pose_cov: Array
    cross_cov: Array
    map_cov: Array | DeferredCovariance
    num_seen: Array
    last_seen: Array
    num_missed: Array
    num_pending: Array
    kind: Array
    id: Array
    direction: Array
    descriptor: Array
    step: Array
    next_id: Array
    bias: OdometryBias | None = None
    adaptation: Adaptation | None = None

    @property
    def pose(self) -> Array:
        """Mean pose (3,) [m, m, rad], map frame."""
        return self.mean[..., :3]

    @property
    def cov(self) -> Array:
        """Covariance (D, D) of pose and slots, assembled from its blocks."""
        cross_cov, map_cov = jnp.swapaxes(self.cross_cov, -1, -2), flush(self.map_cov)
        upper = jnp.concatenate([self.pose_cov, self.cross_cov], axis=-1)
        lower = jnp.concatenate([cross_cov, map_cov], axis=-1)
        return jnp.concatenate([upper, lower], axis=-2)

    @property
    def landmark_positions(self) -> Array:
        """Slots (L, 2) of the mean: position [m], or direction of a wall [rad] and 0; map."""
        return self.mean[..., 3:].reshape(self.mean.shape[:-1] + (-1, 2))


def initial_belief(pose: Array, *, max_landmarks: int, cov: Array | None = None) -> Belief:
    """Belief with an initial pose and an empty map.

    Args:
        pose: (3,) [m, m, rad] map frame; its precision is that of the belief.
        max_landmarks: L, slots of the map.
        cov: (3, 3) covariance of the pose; zero by default: the first pose defines the map frame.

    Raises:
        ValueError: `pose` or `cov` has another shape or holds no numbers, `cov` is not symmetric
            and positive semi-definite, or `max_landmarks` is below 1.
    """
    if max_landmarks < 1:
        raise ValueError(f"max_landmarks is {max_landmarks}, not 1 or more")
    pose = as_float("pose", pose, (3,))
    if cov is not None:
        cov = as_float("cov", cov, (3, 3))
        check_covariance("cov", cov, definite=False)
    size, dtype = 3 + 2 * max_landmarks, pose.dtype
    zeros = jnp.zeros(max_landmarks, jnp.int32)
    mean = jnp.zeros(size, dtype).at[:3].set(pose)
    return Belief(
        mean=mean,
        first_estimate=mean,
        pose_cov=jnp.zeros((3, 3), dtype) if cov is None else jnp.asarray(cov, dtype),
        cross_cov=jnp.zeros((3, size - 3), dtype),
        map_cov=jnp.zeros((size - 3, size - 3), dtype),
        num_seen=zeros,
        last_seen=zeros,
        num_missed=zeros,
        num_pending=zeros,
        kind=zeros,
        id=zeros,
        direction=jnp.zeros(max_landmarks, dtype),
        descriptor=jnp.zeros(max_landmarks, dtype),
        step=jnp.zeros((), jnp.int32),
        next_id=jnp.zeros((), jnp.int32),
    )


def grow_belief(belief: Belief, max_landmarks: int) -> Belief:
    """The belief with more slots, `max_landmarks` in all; the added ones are free.

    Raises:
        ValueError: It has more slots already, or its covariance is deferred, not dense.
    """
    _dense_map_cov(belief)
    if max_landmarks < belief.num_seen.size:
        size = belief.num_seen.size
        raise ValueError(f"max_landmarks is {max_landmarks}, less than the {size} slots there are")
    blank = initial_belief(belief.pose, max_landmarks=max_landmarks)
    bias = belief.bias
    if bias is not None:
        bias = bias._replace(map_cov=jnp.zeros((len(bias.cov), 2 * max_landmarks), bias.cov.dtype))
    blank = blank._replace(bias=bias, adaptation=belief.adaptation)

    def put_at_start(old: Array, new: Array) -> Array:
        return new.at[tuple(slice(n) for n in old.shape)].set(old)

    return jax.tree.map(put_at_start, belief, blank)


def add_known_landmarks(
    belief: Belief, positions: Array, cov: Array, kind: int = JUNCTION
) -> Belief:
    """Add landmarks with prior positions to an empty map, in the first slots.

    Args:
        belief: Without landmarks; its covariance must be dense.
        positions: (K, 2) mean positions [m], map frame; K <= L.
        cov: (K, 2, 2) covariances [m^2] of the positions, which are independent.
        kind: Kind of all of them, `JUNCTION` or `CORNER`.

    Raises:
        ValueError: A covariance is not symmetric and positive definite, a shape does not fit, the
            map has no capacity for all of them or is not empty, or the kind is neither.
    """
    dtype = belief.mean.dtype
    positions = as_float("positions", positions, ("K", 2)).astype(dtype)
    count, size = len(positions), belief.num_seen.size
    cov = as_float("cov", cov, (count, 2, 2)).astype(dtype)
    check_covariance("cov", cov)
    if kind not in (JUNCTION, CORNER):
        raise ValueError(f"kind is {kind!r}, not {JUNCTION} (JUNCTION) or {CORNER} (CORNER)")
    if count > size:
        raise ValueError(f"positions holds {count} landmarks, and the belief has {size} slots")
    if not isinstance(belief.num_seen, jax.core.Tracer) and belief.num_seen.any():
        raise ValueError("belief has landmarks already, and known ones go to an empty map")
    index = jnp.arange(count, dtype=jnp.int32)
    mean = belief.mean.at[3 : 3 + 2 * count].set(positions.reshape(-1))
    map_cov = _dense_map_cov(belief)
    blocks = map_cov.reshape(size, 2, size, 2).at[index, :, index].set(cov)
    return belief._replace(
        mean=mean,
        first_estimate=mean,
        map_cov=blocks.reshape(map_cov.shape),
        num_seen=belief.num_seen.at[:count].set(1),
        kind=belief.kind.at[:count].set(kind),
        id=belief.id.at[:count].set(index),
        next_id=jnp.maximum(belief.next_id, jnp.int32(count)),
    )


def _dense_map_cov(belief: Belief) -> Array:
    """The covariance (2 L, 2 L) of the slots; ValueError if it is deferred."""
    if isinstance(belief.map_cov, DeferredCovariance):
        raise ValueError("belief.map_cov is deferred: flush it first")
    return belief.map_cov


def record_observations(belief: Belief, features: Features, slot: Array) -> Belief:
    """Record the observations of a scan in the tracks of the matched landmarks.

    Args:
        belief: Belief.
        features: Features of the scan.
        slot: (M,) int32 slot of each feature's landmark; L, where it has none, is dropped.
    """
    return belief._replace(
        num_seen=belief.num_seen.at[slot].add(1, mode="drop"),
        last_seen=belief.last_seen.at[slot].set(belief.step, mode="drop"),
        num_missed=belief.num_missed.at[slot].set(0, mode="drop"),
        descriptor=belief.descriptor.at[slot].set(features.descriptor, mode="drop"),
    )


def eviction_cost(belief: Belief, confirmed: Array, *, evict_after: int) -> Array:
    """Eviction cost of each slot (L,): the slot of least cost is reused first.

    It is zero for free slots, and infinite for confirmed landmarks and those observed within the
    last `evict_after` steps. The other candidates are ordered by the number of observations, then
    by the step of the last one:

        cost = num_seen + 1 - age / (1 + max(step, age)),      age = step - last_seen

    Args:
        belief: Belief.
        confirmed: (L,) bool, landmarks that are confirmed.
        evict_after: Largest age [steps] at which a candidate is kept.
    """
    dtype = belief.mean.dtype
    age = belief.step - belief.last_seen
    relative_age = age.astype(dtype) / (1 + jnp.maximum(belief.step, age)).astype(dtype)
    cost = belief.num_seen.astype(dtype) + 1.0 - relative_age
    cost = jnp.where(confirmed | (age <= evict_after), jnp.inf, cost)
    return jnp.where(belief.num_seen == 0, 0.0, cost)


def prune(belief: Belief, gone: Array) -> Belief:
    """Prune landmarks: free the slots (L,) bool; their values are overwritten on reuse."""
    return belief._replace(num_seen=jnp.where(gone, 0, belief.num_seen))
