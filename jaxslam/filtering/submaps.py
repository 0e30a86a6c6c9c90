"""Submaps: maps of bounded size that the filter makes one after the other, each in its own frame.

A dense covariance grows with the square of the number of landmarks. Here the filter starts afresh
every few metres, at the origin of a new frame, with an empty map and without uncertainty. What it
has estimated until then is closed as a `Submap`: a Gaussian of the robot's last pose, which is the
origin of the next submap, and of the landmarks.

    submap 0              submap 1              submap 2
    o--------------> o    o--------------> o    o------ ...
    origin    last pose = origin    last pose = origin

No measurement and no increment of odometry is in two submaps, and none starts from what another has
estimated. Their errors are therefore independent, and all of them may be joined without counting
anything twice, also where they hold the same landmark (`smoothing.submap_joining`).

References:
    Huang, Wang, Dissanayake (2008), Sparse local submap joining filter for building large-scale
    maps. Tardos, Neira, Newman, Leonard (2002), Robust mapping and localization in indoor
    environments using sonar data.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.types import WALL
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import FilterConfig, confirmed, init
from jaxslam.filtering.covariance import flush


class Submap(NamedTuple):
    """What the filter has estimated in one submap: n landmarks; NumPy, float64, submap frame.

    Attributes:
        last_pose: (3,) [m, m, rad] last pose of the robot, the origin of the next submap.
        positions: (n, 2) [m] of the landmarks.
        cov: (3 + 2 n, 3 + 2 n) covariance of last pose and positions.
        id: (n,) int32 of the landmarks, as in `StepInfo.id` of the scans of this submap.
        kind: (n,) int32 `JUNCTION` or `CORNER`.
        direction: (n,) [rad] bisector of the free side of a corner.
        descriptor: (n,) clearance [m] of a junction, angle of the free side [rad] of a corner.
    """

    last_pose: np.ndarray
    positions: np.ndarray
    cov: np.ndarray
    id: np.ndarray
    kind: np.ndarray
    direction: np.ndarray
    descriptor: np.ndarray


def begin_submap(config: FilterConfig) -> Belief:
    """The belief at the start of a submap: the robot at its origin, an empty map.

    Raises:
        ValueError: The configuration is wrong (`check_config`), or has biases or scales of the
            noise that are estimated: their priors would count once for each submap.
    """
    for name in ("odometry_bias_std", "adaptation"):
        if getattr(config, name, None) is not None:
            raise ValueError(f"config.{name} is given: submaps would each begin with it anew")
    return init(config, jnp.zeros(3))


def close_submap(config: FilterConfig, belief: Belief) -> Submap:
    """The submap of a belief that began with `begin_submap`; its confirmed points are landmarks.

    Unconfirmed landmarks, which have updated nothing, and directions of walls, which have, are
    marginalised out.
    """
    belief = jax.device_get(belief._replace(map_cov=flush(belief.map_cov)))
    seen = (belief.num_seen > 0) & np.asarray(confirmed(config, belief)) & (belief.kind != WALL)
    slot = np.flatnonzero(seen)
    cov = np.block([[belief.pose_cov, belief.cross_cov], [belief.cross_cov.T, belief.map_cov]])
    rows = np.concatenate([np.arange(3), point_rows(slot)])
    return Submap(
        last_pose=np.asarray(belief.mean[:3], float),
        positions=np.asarray(belief.mean[3:], float).reshape(-1, 2)[slot],
        cov=cov[np.ix_(rows, rows)].astype(float),
        id=np.asarray(belief.id)[slot],
        kind=np.asarray(belief.kind)[slot],
        direction=np.asarray(belief.direction[slot], float),
        descriptor=np.asarray(belief.descriptor[slot], float),
    )


def point_rows(index: np.ndarray) -> np.ndarray:
    """Rows (2 k,) of points (k,) in a state of a pose and points."""
    return (3 + 2 * index[:, None] + np.arange(2)).reshape(-1)
