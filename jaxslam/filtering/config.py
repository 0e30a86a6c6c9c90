"""Static configuration of the filter, and what follows from it: initial belief, confirmation."""

import math
from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core.types import CORNER, JUNCTION, WALL, Array
from jaxslam.filtering.belief import Belief, initial_belief
from jaxslam.filtering.data_association import AssociationSpec


class FilterConfig(NamedTuple):
    """Static configuration of the filter; hashable, static under jit.

    Attributes:
        landmark_kinds: Kinds of landmark that the filter uses.
        linearisation: `"standard"`, the paper's, or another of `ekf.LINEARISATIONS`.
        max_landmarks: L, capacity of the map.
        max_updates: Largest number of features that update the state in one scan.
        max_new: Largest number of new landmarks in one scan.
        association: Thresholds of data association.
        untrusted_inflation: Factor on the standard deviation of features that are not trusted.
        confirm_count: Number of observations (this one included) from which a landmark is
            confirmed. Only confirmed landmarks update the state.
        wall_confirm_count: Likewise for a wall direction: most scans show one, and a wrong one
            biases the heading.
        max_unconfirmed_age: Number of steps without an observation after which an unconfirmed
            landmark is pruned.
        evict_after: Number of steps without an observation after which an unconfirmed landmark
            may be evicted from a full map.
        max_misses: Number of consecutive missed detections after which a junction is pruned.
        field_of_view: [rad] directions of the scanner's first and last beam: outside, a detection
            cannot be missed. `Config.for_lidar` sets it.
    """

    landmark_kinds: tuple[int, ...] = (JUNCTION, CORNER, WALL)
    linearisation: str = "standard"
    max_landmarks: int = 96
    max_updates: int = 8
    max_new: int = 8
    association: AssociationSpec = AssociationSpec()
    untrusted_inflation: float = 3.0
    confirm_count: int = 2
    wall_confirm_count: int = 4
    max_unconfirmed_age: int = 40
    evict_after: int = 5
    max_misses: int = 10
    field_of_view: tuple[float, float] = (-math.pi / 2, math.pi / 2)


def init(config: FilterConfig, pose: Array, cov: Array | None = None) -> Belief:
    """Initial belief of a robot with an empty map.

    Args:
        config: FilterConfiguration of the filter.
        pose: (3,) [m, m, rad] first pose, map frame.
        cov: (3, 3) covariance of the pose; zero by default, as the map has no other origin.

    Raises:
        ValueError: The covariance is not symmetric and positive semi-definite.
    """
    return initial_belief(pose, max_landmarks=config.max_landmarks, cov=cov)


def required_observations(config: FilterConfig, kind: Array) -> Array:
    """Number of observations (...) that confirm landmarks of these kinds (...) int32."""
    return jnp.where(kind == WALL, config.wall_confirm_count, config.confirm_count)


def confirmed(config: FilterConfig, belief: Belief) -> Array:
    """Landmarks (L,) bool with enough observations to update the state."""
    return belief.num_seen >= required_observations(config, belief.kind)
