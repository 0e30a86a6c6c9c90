"""Hypotheses of where the robot is: predicted by odometry, fitted to scans, weighed, kept distinct.

The log weight of a hypothesis, of which one is always 0, is updated with its score s of a scan by

    log_weight <- memory^a log_weight + score_weight a s

where a is the motion since the scan before, in windows (`LocaliseSpec.window_distance`), at most 1:
successive scans of a robot that stands show the same, and are no new evidence. A place that the map
does not show has the score `nowhere_score`. What is remembered is thus the evidence of the last
1 / (1 - memory) windows, so a robot that was carried is found again within a few metres.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.se2 import compose, wrap_angle
from jaxslam.core.types import Array
from jaxslam.localisation.config import Hypotheses, LocaliseSpec, PlaceMap
from jaxslam.localisation.free_space import map_score
from jaxslam.matching.place_fit import PlaceQuery, fit_pose

SCORE_MEMORY = 0.7
"""Share of the mean score that is kept from one window to the next."""

ENOUGH_POINTS = 30.0
"""Points of a scan from which on it is full evidence."""


@partial(jax.jit, static_argnums=0)
def no_hypotheses(count: int) -> Hypotheses:
    """H hypotheses that do not exist."""
    cov = jnp.broadcast_to(jnp.eye(3), (count, 3, 3))
    nothing = jnp.zeros(count)
    return Hypotheses(jnp.zeros((count, 3)), cov, nothing - jnp.inf, *[nothing] * 4)


def std_cov(std: tuple[float, float]) -> Array:
    """Covariance (3, 3) of a pose of a std [m], [rad]."""
    return jnp.diag(jnp.array([std[0], std[0], std[1]]) ** 2)


def windows_moved(spec: LocaliseSpec, odometry: Array) -> Array:
    """Motion () of an increment (3,) in windows."""
    by_distance = jnp.hypot(odometry[0], odometry[1]) / spec.window_distance[0]
    return by_distance + jnp.abs(odometry[2]) / spec.window_distance[1]


def predict(spec: LocaliseSpec, hypotheses: Hypotheses, odometry: Array) -> Hypotheses:
    """Hypotheses after an odometry increment (3,)."""
    distance, turn = jnp.hypot(odometry[0], odometry[1]), jnp.abs(odometry[2])
    floor, slip = spec.odometry_std_floor, spec.odometry_slip
    own = floor[0] ** 2 + (slip[0] * distance) ** 2
    heading = floor[1] ** 2 + (slip[1] * turn) ** 2
    noise = jnp.diag(jnp.stack([own, own, heading]))

    def move(pose: Array, cov: Array) -> tuple[Array, Array]:
        after = compose(pose, odometry)
        arm = after - pose
        jacobian = jnp.eye(3).at[0, 2].set(-arm[1]).at[1, 2].set(arm[0])
        return after, jacobian @ cov @ jacobian.T + noise

    poses, cov = jax.vmap(move)(hypotheses.poses, hypotheses.cov)
    return hypotheses._replace(poses=poses, cov=cov, driven=hypotheses.driven + distance)


def fit(
    spec: LocaliseSpec, place_map: PlaceMap, query: PlaceQuery, hypotheses: Hypotheses
) -> tuple[Hypotheses, Array]:
    """Hypotheses that are fitted to a scan, and their scores (H,) of it; no weight is changed."""
    stds = (spec.point_std,) * len(spec.gates)

    def of_one(pose: Array, cov: Array) -> tuple[Array, Array, Array]:
        prior = inverse(cov)
        found = fit_pose(spec.place, place_map.places, query, spec.gates, stds, pose, prior)
        after = inverse(prior + found.information)
        good = jnp.all(jnp.isfinite(found.pose)) & jnp.all(jnp.isfinite(after))
        pose = jnp.where(good, found.pose, pose)
        pose = pose.at[2].set(wrap_angle(pose[2]))
        score = map_score(spec, place_map, query, pose)
        return pose, jnp.where(good, after, cov), score

    poses, cov, scores = jax.vmap(of_one)(hypotheses.poses, hypotheses.cov)
    return hypotheses._replace(poses=poses, cov=cov), scores


def weigh(
    spec: LocaliseSpec,
    hypotheses: Hypotheses,
    nowhere: Array,
    scores: Array,
    amount: Array,
) -> tuple[Hypotheses, Array]:
    """Hypotheses and nowhere () with the evidence of a scan added.

    Args:
        spec: Options.
        hypotheses: Fitted to the scan.
        nowhere: () log weight of being where the map does not show.
        scores: (H,) of the scan.
        amount: () evidence that it is, 0 to 1.
    """
    kept, gain = spec.memory**amount, spec.score_weight * amount
    weights = kept * hypotheses.log_weight + gain * scores
    weights = jnp.where(jnp.isfinite(hypotheses.log_weight), weights, -jnp.inf)
    mean = hypotheses.score + (1.0 - SCORE_MEMORY**amount) * (scores - hypotheses.score)
    windows = jnp.minimum(hypotheses.windows + amount, spec.path_windows)
    share = amount / jnp.maximum(windows, amount + 1e-6)
    hypotheses = hypotheses._replace(
        log_weight=weights,
        score=mean,
        path_score=hypotheses.path_score + share * (scores - hypotheses.path_score),
        windows=windows,
    )
    nowhere = kept * nowhere + gain * spec.nowhere_score
    return limited(spec, hypotheses, nowhere)


def limited(spec: LocaliseSpec, hypotheses: Hypotheses, nowhere: Array) -> tuple[Hypotheses, Array]:
    """The same log weights with the largest 0, and none below `max_log_odds` less than it.

    A hypothesis that has less is given up; nowhere never is.
    """
    top = jnp.maximum(jnp.max(hypotheses.log_weight), nowhere)
    weights = hypotheses.log_weight - top
    weights = jnp.where(weights > -spec.max_log_odds, weights, -jnp.inf)
    nowhere = jnp.maximum(nowhere - top, -spec.max_log_odds)
    return hypotheses._replace(log_weight=weights), nowhere


def keep_best(spec: LocaliseSpec, pool: Hypotheses) -> Hypotheses:
    """The H best of a pool of hypotheses, one of each place.

    One that takes the place of another of the same place keeps the longest of their paths, and what
    was seen on it.
    """

    def take(left: Array, _: None) -> tuple[Array, Hypotheses]:
        best = jnp.argmax(left)
        off = pool.poses - pool.poses[best][None]
        near = jnp.hypot(off[:, 0], off[:, 1]) < spec.place.distinct[0]
        same = near & (jnp.abs(wrap_angle(off[:, 2])) < spec.place.distinct[1])
        driven = jnp.where(same & jnp.isfinite(left), pool.driven, -1.0)
        longest = jnp.where(driven[best] >= jnp.max(driven), best, jnp.argmax(driven))
        chosen = jax.tree.map(lambda x: x[best], pool)
        chosen = chosen._replace(
            log_weight=left[best],
            path_score=pool.path_score[longest],
            windows=pool.windows[longest],
            driven=pool.driven[longest],
        )
        return jnp.where(same, -jnp.inf, left), chosen

    return lax.scan(take, pool.log_weight, length=spec.num_hypotheses)[1]


def log_odds(spec: LocaliseSpec, hypotheses: Hypotheses, nowhere: Array) -> Array:
    """Log odds () of the first hypothesis, the best, against all others and nowhere."""
    rest = jnp.append(hypotheses.log_weight[1:], nowhere)
    best = hypotheses.log_weight[0]
    odds = jnp.where(jnp.isfinite(best), best, -spec.max_log_odds) - jax.nn.logsumexp(rest)
    return jnp.clip(odds, -spec.max_log_odds, spec.max_log_odds)


def evidence(query: PlaceQuery, windows: Array) -> Array:
    """How much evidence () a scan is after a motion of some windows, 0 to 1."""
    seen = jnp.sum(query.valid, dtype=windows.dtype) / ENOUGH_POINTS
    return jnp.minimum(windows, 1.0) * jnp.minimum(seen, 1.0)


def inverse(matrix: Array) -> Array:
    """Inverse of a symmetric matrix (3, 3), by its cofactors."""
    a, b, c = matrix
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
    return 0.5 * (rows + rows.T) / (a @ rows[0])


def widest_std(cov: Array) -> Array:
    """Largest std () [m] of the position, over all directions, of a covariance (3, 3)."""
    mean, half = (cov[0, 0] + cov[1, 1]) / 2, (cov[0, 0] - cov[1, 1]) / 2
    return jnp.sqrt(jnp.maximum(mean + jnp.hypot(half, cov[0, 1]), 0.0))
