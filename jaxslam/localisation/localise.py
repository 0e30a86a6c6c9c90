"""Localisation: where a robot is in a map that was made before, scan by scan, without a guess.

    place_map = make_map(spec, saved_map)
    state = init(spec, lidar)                       # anywhere; or `pose=` where it is about
    for scan, odometry in ...:
        state, info = step(spec, lidar, place_map, state, scan, odometry)
        info.pose, info.probability

Several poses are tracked at once, each fitted to every scan by ICP and weighed by how well it
explains the scans (`hypotheses`). Look-alike places are distinguished by driving on; as long as
two explain the scans about as well, it is not sure. Where no pose explains a scan, or the robot is
not sure, the whole map is searched (`search`): so it is found at the start, and again after it was
carried. The map is not changed. All of a step is of one size, whatever the robot has seen.

A batch of robots, or of starts, is one `jax.vmap`:

    states = jax.vmap(lambda _: init(spec, lidar))(jnp.arange(1000))
    steps = jax.jit(jax.vmap(partial(step, spec, lidar), in_axes=(None, 0, 0, 0)))
    states, infos = steps(place_map, states, scans, odometry)

in which a search costs only those robots that need it. On a CPU it is a loop over the robots.

References:
    Jensfelt, Kristensen (2001), Active global localization for a mobile robot using multiple
    hypothesis tracking. Thrun, Burgard, Fox (2005), Probabilistic Robotics, chapter 8.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core import trace_cache
from jaxslam.core.batching import sequential_vmap_on_cpu
from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.types import AnyArray, Array, as_float64
from jaxslam.localisation.config import (
    LocaliseInfo,
    LocaliseSpec,
    LocaliseState,
    PlaceMap,
    check_localise_spec,
)
from jaxslam.localisation.free_space import free_space, map_score
from jaxslam.localisation.hypotheses import (
    evidence,
    fit,
    keep_best,
    log_odds,
    no_hypotheses,
    predict,
    std_cov,
    weigh,
    widest_std,
    windows_moved,
)
from jaxslam.localisation.probability import features, probability
from jaxslam.localisation.search import (
    Found,
    add_to_window,
    clear_window,
    empty_window,
    is_wanted,
    move_window,
    search_where,
)
from jaxslam.mapping.saved_map import SavedMap
from jaxslam.matching import checks
from jaxslam.matching.place_fit import PlaceQuery
from jaxslam.matching.place_index import build_index
from jaxslam.matching.place_recognition import make_query

IS_FIRST = -1
"""Scans since the last search before the first scan."""


def make_map(spec: LocaliseSpec, saved_map: SavedMap) -> PlaceMap:
    """What localisation needs of a saved map; made once, on the host.

    Raises:
        ValueError: An option is out of range, or the map has no keyframe.
    """
    return map_of_scans(spec, saved_map.lidar, saved_map.poses, saved_map.scans)


def map_of_scans(spec: LocaliseSpec, lidar: Lidar, poses: AnyArray, scans: Scan) -> PlaceMap:
    """The same of scans at known poses.

    Args:
        spec: Options.
        lidar: The scanner that made them.
        poses: (K, 3) [m, m, rad] of the scanner, map frame.
        scans: [K].

    Raises:
        ValueError: An option is out of range, or poses and scans are not K >= 1 each, those of
            this lidar, and finite.
    """
    check_localise_spec(spec)
    places = build_index(spec.place, lidar, poses, scans)
    free = free_space(spec, lidar, places, poses, scans)
    return PlaceMap(places, free, jnp.asarray(lidar.range_max, float))


def init(spec: LocaliseSpec, lidar: Lidar, pose: Any = None) -> LocaliseState:
    """State of a robot before its first scan.

    Args:
        spec: Options.
        lidar: The scanner of the robot; it may be another one than that of the map.
        pose: (3,) [m, m, rad] of the scanner, map frame, where it is about; None: anywhere.

    Raises:
        ValueError: An option is out of range, or `pose` is not a finite pose.
    """
    check_localise_spec(spec)
    check_lidar(lidar)
    hypotheses = no_hypotheses(spec.num_hypotheses)
    nowhere = jnp.zeros(())
    if pose is not None:
        given = as_float64("pose", pose, (3,))
        if not np.isfinite(given).all():
            raise ValueError(f"pose is {given.tolist()}, which is not finite")
        hypotheses = hypotheses._replace(
            poses=hypotheses.poses.at[0].set(jnp.asarray(given, float)),
            cov=hypotheses.cov.at[0].set(std_cov(spec.given_std)),
            log_weight=hypotheses.log_weight.at[0].set(0.0),
        )
        nowhere = nowhere - spec.given_log_odds
    return LocaliseState(
        hypotheses,
        nowhere,
        empty_window(spec, lidar),
        jnp.array(False),
        jnp.zeros(()),
        jnp.int32(IS_FIRST),
    )


def step(
    spec: LocaliseSpec,
    lidar: Lidar,
    place_map: PlaceMap,
    state: LocaliseState,
    scan: Scan,
    odometry: AnyArray,
) -> tuple[LocaliseState, LocaliseInfo]:
    """The state after one scan, and where the robot is.

    Odometry that is not finite counts as no motion, and beams that are not finite as no return.
    Call it by `jax.jit(step, static_argnums=(0, 1))`.

    Args:
        spec: Options.
        lidar: The scanner of the robot.
        place_map: By `make_map`.
        state: After the scan before.
        scan: One scan.
        odometry: (3,) [m, m, rad] motion since the scan before, in its frame; zero at the first.

    Raises:
        ValueError: Scan or odometry are not those of this lidar.
    """
    check_localise_spec(spec)
    check_lidar(lidar)
    scan = checks.as_scans("scan", lidar, scan)
    odometry = checks.as_default_float("odometry", odometry, (3,))
    one = sequential_vmap_on_cpu(partial(_step, spec, lidar))
    return one(place_map, state, scan, odometry)


@partial(trace_cache.jit, static_argnames=("spec", "lidar"))
def run_steps(
    spec: LocaliseSpec,
    lidar: Lidar,
    place_map: PlaceMap,
    state: LocaliseState,
    scans: Scan,
    odometry: Array,
    count: Array,
) -> tuple[LocaliseState, LocaliseInfo]:
    """Steps over scans [T], of which the first `count` exist: one `lax.scan`, compiled.

    Args:
        spec: Options.
        lidar: The scanner of the robot.
        place_map: By `make_map`.
        state: Before the first of them.
        scans: [T].
        odometry: (T, 3) [m, m, rad] motion since the scan before.
        count: () int32; the others are padding and leave the state as it is.
    """

    def body(
        state: LocaliseState, now: tuple[Scan, Array, Array]
    ) -> tuple[LocaliseState, LocaliseInfo]:
        scan, odometry, exists = now
        after, info = _step(spec, lidar, place_map, state, scan, odometry)
        return jax.tree.map(partial(jnp.where, exists), after, state), info

    exists = jnp.arange(len(odometry), dtype=jnp.int32) < count
    return lax.scan(body, state, (scans, odometry, exists))


def _step(
    spec: LocaliseSpec,
    lidar: Lidar,
    place_map: PlaceMap,
    state: LocaliseState,
    scan: Scan,
    odometry: Array,
) -> tuple[LocaliseState, LocaliseInfo]:
    """`step` of what has been checked."""
    first = state.searched_scans == IS_FIRST
    odometry = jnp.where(jnp.all(jnp.isfinite(odometry)), odometry, 0.0)
    seen = scan.hit & jnp.isfinite(scan.ranges) & (scan.ranges < place_map.range_max)
    scan = Scan(jnp.where(seen, scan.ranges, lidar.range_max), seen)

    query = make_query(spec.place, lidar, jax.tree.map(lambda x: x[None], scan), jnp.zeros((1, 3)))
    shows = jnp.any(query.valid)
    amount = evidence(query, jnp.where(first, 1.0, windows_moved(spec, odometry)))
    tracked, scores = fit(spec, place_map, query, predict(spec, state.hypotheses, odometry))
    tracked, nowhere = weigh(spec, tracked, state.nowhere, scores, amount)
    best = jnp.argmax(tracked.log_weight)
    exists = jnp.isfinite(tracked.log_weight[best])
    lost = shows & ~(exists & (scores[best] >= spec.lost_score))
    newly = lost & ~state.lost
    window = clear_window(move_window(state.window, odometry), newly)
    tracked = keep_best(spec, tracked)
    distance = state.searched_distance + jnp.hypot(odometry[0], odometry[1])
    searched = shows & is_wanted(
        spec,
        lost=lost,
        newly=newly,
        driven=tracked.driven[0],
        distance=distance,
        scans=state.searched_scans + 1,
    )
    found = search_where(
        spec, lidar, searched, Found(tracked, nowhere), place_map, scan, query, window
    )
    info = _info(spec, place_map, query, found)._replace(searched=searched)
    state = LocaliseState(
        found.hypotheses,
        found.nowhere,
        add_to_window(spec, window, scan),
        lost,
        jnp.where(searched, 0.0, distance),
        jnp.where(searched, 0, state.searched_scans + 1),
    )
    return state, info


def _info(spec: LocaliseSpec, place_map: PlaceMap, query: PlaceQuery, found: Found) -> LocaliseInfo:
    """What is known of the pose of the last scan."""
    own = found.hypotheses
    exists = jnp.isfinite(own.log_weight)
    odds = log_odds(spec, own, found.nowhere)
    scan_score = map_score(spec, place_map, query, own.poses[0])
    known = own.path_score[0], own.windows[0], widest_std(own.cov[0])
    return LocaliseInfo(
        own.poses[0],
        own.cov[0],
        jnp.where(exists[0], probability(features(odds, *known)), 0.0),
        odds,
        own.score[0],
        scan_score,
        own.path_score[0],
        own.windows[0],
        own.driven[0],
        jnp.sum(exists, dtype=jnp.int32),
        jnp.array(False),
    )
