"""Search of the whole map for places that explain the last scans, to be tracked as hypotheses.

A place that is found has the log weight that it would have if it had been tracked for as long as
the window is, by the joint scores S of the scans in it: with N of them, and against the best
hypothesis b that is tracked (nowhere, if that is better, or if there is none),

    log_weight = log_weight_b + score_weight N (S - S_b) + found_log_odds

A place that is tracked already stays as it is, unless what was found has the larger log weight.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.core.batching import update_where
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import compose, relative
from jaxslam.core.types import Array
from jaxslam.localisation.config import Hypotheses, LocaliseSpec, PlaceMap, Window
from jaxslam.localisation.free_space import map_score
from jaxslam.localisation.hypotheses import (
    fit,
    inverse,
    keep_best,
    limited,
    std_cov,
    windows_moved,
)
from jaxslam.matching.place_fit import PlaceQuery, fit_pose
from jaxslam.matching.place_recognition import KERNEL, find_places, make_query

LONG_TRACKED = 10.0
"""[m] of a path after which a pose is known for long."""


class Found(NamedTuple):
    """What a search changes: the hypotheses, and the log weight () of nowhere."""

    hypotheses: Hypotheses
    nowhere: Array


@partial(jax.jit, static_argnums=(0, 1))
def empty_window(spec: LocaliseSpec, lidar: Lidar) -> Window:
    """A window without scans."""
    size = spec.window_scans - 1
    nothing = jnp.zeros((size, lidar.num_beams))
    return Window(
        Scan(nothing, nothing > 0.0), jnp.zeros((size, 3)), jnp.zeros(size, bool), jnp.int32(0)
    )


def move_window(window: Window, odometry: Array) -> Window:
    """The window in the frame after an increment (3,)."""
    back = relative(odometry, jnp.zeros_like(odometry))
    return window._replace(poses=jax.vmap(partial(compose, back))(window.poses))


def clear_window(window: Window, cleared: Array) -> Window:
    """The window, without its scans where it is `cleared` () bool."""
    return window._replace(used=window.used & ~cleared)


def add_to_window(spec: LocaliseSpec, window: Window, scan: Scan) -> Window:
    """The window with the scan that came last, if it is far enough from those in it."""
    size = spec.window_scans - 1
    newest = (window.num_added - 1) % size
    far = windows_moved(spec, window.poses[newest]) >= 1.0
    new = far | ~jnp.any(window.used)
    slot = jnp.where(new, window.num_added % size, size)

    def put(held: Array, item: Array) -> Array:
        return held.at[slot].set(item, mode="drop")

    return Window(
        jax.tree.map(put, window.scans, scan),
        put(window.poses, jnp.zeros(3)),
        put(window.used, jnp.array(True)),
        window.num_added + new.astype(jnp.int32),
    )


def search_where(
    spec: LocaliseSpec,
    lidar: Lidar,
    wanted: Array,
    found: Found,
    place_map: PlaceMap,
    scan: Scan,
    of_scan: PlaceQuery,
    window: Window,
) -> Found:
    """Hypotheses after a search, where it is `wanted` () bool; cheap where it is not.

    Args:
        spec: Options.
        lidar: The scanner of the robot.
        wanted: () bool.
        found: Hypotheses that are tracked.
        place_map: The map.
        scan: The last scan.
        of_scan: The query of it alone.
        window: Those before.
    """
    update = partial(_search, spec, lidar)
    given = place_map, scan, of_scan, window
    return update_where(wanted, update, found, *given, block=spec.search_block)


def _search(
    spec: LocaliseSpec,
    lidar: Lidar,
    tracked: Found,
    place_map: PlaceMap,
    scan: Scan,
    of_scan: PlaceQuery,
    window: Window,
) -> Found:
    """Hypotheses after a search."""
    own = tracked.hypotheses
    scans = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), window.scans, scan)
    used = jnp.append(window.used, True)
    scans = scans._replace(hit=scans.hit & used[:, None])
    query = make_query(spec.place, lidar, scans, jnp.append(window.poses, jnp.zeros((1, 3)), 0))
    places = find_places(spec.place, place_map.places, query)
    # The last "hypothesis" is nowhere.
    weights = jnp.append(own.log_weight, tracked.nowhere)
    score_of = jax.vmap(partial(_window_score, spec, place_map, query))
    scores = jnp.append(score_of(own.poses), spec.nowhere_score)
    best = jnp.argmax(weights)
    weight = spec.score_weight * jnp.sum(used, dtype=scores.dtype)
    of_new, of_old = spec.found_log_odds
    tracked_share = jnp.append(jnp.minimum(own.driven / LONG_TRACKED, 1.0), 0.0)[best]
    of_places = jax.vmap(partial(map_score, spec, place_map, query))(places.poses)
    of_places = jnp.where(jnp.isfinite(places.score), of_places, -jnp.inf)
    log_weight = weights[best] + weight * (of_places - scores[best])
    log_weight += of_new + tracked_share * (of_old - of_new)
    count = len(places.score)
    candidates = Hypotheses(
        places.poses,
        jnp.broadcast_to(std_cov(spec.start_std), (count, 3, 3)),
        log_weight,
        of_places,
        of_places,
        jnp.full(count, jnp.sum(used, dtype=scores.dtype)),
        jnp.zeros(count),
    )
    # The window is as good as the odometry: the last scan alone says where the robot is now.
    candidates = fit(spec, place_map, of_scan, candidates)[0]
    pool = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), own, candidates)
    return Found(*limited(spec, keep_best(spec, pool), tracked.nowhere))


def _window_score(spec: LocaliseSpec, place_map: PlaceMap, query: PlaceQuery, pose: Array) -> Array:
    """Score () of the scans of the window at a pose (3,), fitted to them as those found are."""
    place = spec.place
    stds = tuple(KERNEL * gate for gate in place.fine_gates)
    prior = inverse(std_cov(spec.start_std))
    fitted = fit_pose(place, place_map.places, query, place.fine_gates, stds, pose, prior)
    return map_score(spec, place_map, query, fitted.pose)


def is_wanted(
    spec: LocaliseSpec, *, lost: Array, newly: Array, driven: Array, distance: Array, scans: Array
) -> Array:
    """Whether a robot is to be looked for; () bool.

    The longer its pose has been tracked, the rarer is the search; each is another chance to find
    a place that explains more.

    Args:
        spec: Options.
        lost: () bool, no hypothesis explains the last scan.
        newly: () bool, and that was not so at the scan before.
        driven: () [m] since the best hypothesis was found.
        distance: () [m] driven since the last search.
        scans: () int32 scans since the last search.
    """
    least, most = spec.search_distance
    due = distance >= jnp.clip(spec.search_share * driven, least, most)
    return due | (lost & (newly | (scans >= spec.lost_scans)))
