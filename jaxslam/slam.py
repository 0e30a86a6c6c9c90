"""EKF-SLAM of one robot: features of a scan, one step of the filter, the filter over a log.

`step` is the only place where the front end and the filter meet.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam import alignment, edges, ekf, junctions, links, nodes, programs, voronoi
from jaxslam.alignment import Aligned, AlignSpec
from jaxslam.batches import map_batches
from jaxslam.belief import Belief, forget, initial, note, worth
from jaxslam.closures import ClosureSpec
from jaxslam.conditioning import Conditioned, Rows, drop, innovation_cov, log_likelihood
from jaxslam.edges import RunSpec
from jaxslam.grid import GridSpec, rasterise, seen_free
from jaxslam.lidar import Lidar, Scan
from jaxslam.links import Links
from jaxslam.motion import process_noise
from jaxslam.nodes import Nodes, NodeSpec
from jaxslam.noise import Noise, sensor_noise
from jaxslam.noise import log_noise as log_noise
from jaxslam.noise import sighting_noise as sighting_noise
from jaxslam.noise import wheel_noise as wheel_noise
from jaxslam.recognition import (
    MatchSpec,
    Recognised,
    identify,
    overdue,
    recognise,
    second_look,
    twin,
)
from jaxslam.types import CORNER, NODE, WALL, Array

BATCH = 16  # scans whose features are extracted together


class Config(NamedTuple):
    """Static configuration: all that fixes shapes or branches; hashable, static under jit.

    Attributes:
        lidar: Laser scanner.
        grid: Local occupancy grid of a scan.
        runs: Extraction of straight wall segments.
        nodes: Extraction of features.
        labels: Sources of the Voronoi diagram: `"runs"`, the wall segments of the scan, or
            `"codes"`, the paper's edge codes of occupied cells.
        kinds: Kinds of landmark that the filter uses.
        steps: Number of steps of the cellular automaton.
        linearisation: `"standard"`, the paper's, or another of `ekf.LINEARISATIONS`.
        landmarks: L, capacity of the map.
        matches: Largest number of features that update the state in one scan.
        fresh: Largest number of new landmarks in one scan.
        matching: Thresholds of data association.
        alignment: Scan matching, where odometry is fused with it.
        closures: Loop closures, for batch smoothing of such a trajectory.
        doubt: Inflation factor on the standard deviation of features that are not trusted.
        confirm: Number of observations (this one included) from which a landmark is confirmed.
            Only confirmed landmarks update the state.
        wall_confirm: Likewise for a wall direction: most scans show one, and a wrong one biases
            the heading.
        patience: Number of steps without an observation after which an unconfirmed landmark is
            pruned.
        idle: Number of steps without an observation after which an unconfirmed landmark may be
            evicted from a full map.
        misses: Number of consecutive missed detections after which a junction is pruned.
    """

    lidar: Lidar = Lidar()
    grid: GridSpec = GridSpec()
    runs: RunSpec = RunSpec()
    nodes: NodeSpec = NodeSpec()
    labels: str = "runs"
    kinds: tuple[int, ...] = (NODE, CORNER, WALL)
    steps: int = 32
    linearisation: str = "standard"
    landmarks: int = 96
    matches: int = 8
    fresh: int = 8
    matching: MatchSpec = MatchSpec()
    alignment: AlignSpec = AlignSpec()
    closures: ClosureSpec = ClosureSpec()
    doubt: float = 3.0
    confirm: int = 2
    wall_confirm: int = 4
    patience: int = 40
    idle: int = 5
    misses: int = 10


class Inputs(NamedTuple):
    """Measurements of one step: odometry increment and features.

    Attributes:
        motion: (3,) [m, m, rad] odometry since the scan before, frame of the pose before.
        nodes: (M) features of this scan, base_link frame.
        known: (M,) int32 known landmark 0..L-1 of each feature, -1 for none; None: associate.
        aligned: The same increment by scan matching, to be fused with the odometry, if any.
    """

    motion: Array
    nodes: Nodes
    known: Array | None = None
    aligned: Aligned | None = None


class Info(NamedTuple):
    """Diagnostics of one step; the next step does not depend on them.

    Attributes:
        pose: (3,) [m, m, rad] estimated, map frame.
        pose_cov: (3, 3) its covariance.
        slot: (M,) int32 slot of each feature's landmark, matched or new; L for none.
        id: (M,) int32 id of that landmark, -1 for none.
        used: (M,) bool, the feature updated the state.
        nis: () normalised innovation squared, of all used features together.
        dof: () int32 its degrees of freedom.
        log_likelihood: () [nats] of the innovations.
        finite: () bool, False where the update was not finite and was left out.
        fresh: () int32 number of new landmarks.
        forgotten: () int32 number of landmarks that were pruned, unconfirmed ones included.
        evicted: () int32 number of unconfirmed landmarks that were evicted from a full map.
        merged: () int32 number of duplicates that were merged.
    """

    pose: Array
    pose_cov: Array
    slot: Array
    id: Array
    used: Array
    nis: Array
    dof: Array
    log_likelihood: Array
    finite: Array
    fresh: Array
    forgotten: Array
    evicted: Array
    merged: Array


def front_end(config: Config, scan: Scan) -> Nodes:
    """Extract the features of one scan, base_link frame."""
    return look(config, scan)[0]


def start_of(run: Array, open: Array) -> Array:
    """Initial cells (H, W) int8 of the automaton, as `voronoi.grow` takes them.

    Args:
        run: (H, W) int8 wall segment of each source cell, -1 elsewhere.
        open: (H, W) bool, cells that fronts may enter.
    """
    empty = jnp.where(open, voronoi.EMPTY, voronoi.SHUT).astype(jnp.int8)
    return jnp.where(run >= 0, run, empty)


def look(config: Config, scan: Scan) -> tuple[Nodes, voronoi.Diagram, Array]:
    """Extract the features of one scan.

    Returns:
        The features (base_link frame), the Voronoi diagram that the junctions come from, and its
        source cells (H, W) bool.

    References:
        Paper, section 2; `labels="codes"` is its method, with fronts that are diamonds.
    """
    lidar, spec = config.lidar, config.grid
    segments = edges.runs(scan, lidar, config.runs)
    if config.labels == "codes":
        grid = rasterise(scan, lidar, spec)
        labels = edges.code_bits(edges.codes(grid, spec))
        start = voronoi.number(labels, grid.free)
        sources = grid.occupied
    else:
        segment = edges.run_cells(scan, lidar, segments, spec)
        sources = segment >= 0
        bit = jnp.uint32(1) << jnp.maximum(segment, 0).astype(jnp.uint32)
        labels = jnp.where(sources, bit, 0)
        start = start_of(segment, seen_free(scan, lidar, spec))
    octagon = config.labels == "runs"
    fronts = voronoi.grow(start, steps=config.steps, octagon=octagon)
    diagram = voronoi.gather(labels, fronts, octagon=octagon)
    cells = voronoi.crowded(fronts, sources)
    features = nodes.join(
        junctions.find_junctions(cells, scan, segments, lidar, spec, config.nodes),
        nodes.find_corners(segments, config.nodes),
        nodes.find_walls(segments, config.nodes),
    )
    return features, diagram, sources


def local_map(config: Config, scan: Scan) -> tuple[Nodes, Links]:
    """Local topological map of one scan: its features, and the arcs between its junctions."""
    features, diagram, sources = look(config, scan)
    arcs = links.find_links(
        features, diagram, sources, scan, config.lidar, config.grid, config.nodes
    )
    return features, arcs


def init(config: Config, pose: Array, cov: Array | None = None) -> Belief:
    """Initial belief of a robot with an empty map.

    Args:
        config: Configuration of the filter.
        pose: (3,) [m, m, rad] first pose, map frame.
        cov: (3, 3) covariance of the pose; zero by default, as the map has no other origin.

    Raises:
        ValueError: The covariance is not symmetric and positive semi-definite.
    """
    return initial(pose, landmarks=config.landmarks, cov=cov)


def needed(config: Config, kind: Array) -> Array:
    """Number of observations (...) that confirm landmarks of these kinds (...) int32."""
    return jnp.where(kind == WALL, config.wall_confirm, config.confirm)


def confirmed(config: Config, belief: Belief) -> Array:
    """Landmarks (L,) bool with enough observations to update the state."""
    return belief.seen >= needed(config, belief.kind)


def moved(noise: Noise, inputs: Inputs) -> tuple[Array, Array]:
    """Odometry increment of a step, fused with scan matching where there is any.

    Returns:
        The increment (3,) [m, m, rad] since the step before, in the frame of that pose, and its
        covariance (3, 3).

    Raises:
        ValueError: There is scan matching, and `noise.alignment` is None; while tracing.
    """
    motion_cov = process_noise(noise.odometry, inputs.motion)
    if inputs.aligned is None:
        return inputs.motion, motion_cov
    if noise.alignment is None:
        raise ValueError("noise.alignment is None, but odometry by scan matching is given")
    return alignment.fuse(inputs.motion, motion_cov, inputs.aligned, noise.alignment)


class _Matches(NamedTuple):
    """Matches of the features of a scan, as `step` narrows them down.

    Attributes:
        slot: (M,) int32 slot of the matched landmark, L for none.
        used: (M,) bool, the match updates the state; a match with an unconfirmed landmark does not.
        order: (K,) int32 feature of each of the K rows of the update.
    """

    slot: Array
    used: Array
    order: Array


def step(config: Config, noise: Noise, belief: Belief, inputs: Inputs) -> tuple[Belief, Info]:
    """One step of EKF-SLAM.

        select     the features of the configured kinds; their covariance R
        predict    the belief by the odometry increment
        associate  features with landmarks of the predicted belief
        choose     the matches that update the state: confirmed landmarks, walls first
        linearise  their innovations
        verify     them jointly, and drop the rejected ones
        update     the belief; leave the update out if it is not finite
        manage     the tracks: record observations, prune landmarks, merge duplicates
        add        new landmarks, evicting unconfirmed ones from a full map

    With `inputs.known` correspondences are given: nothing is associated, verified, pruned or
    merged, and a landmark is confirmed by its first observation. No more than `config.matches`
    features update the state in a step, and no more than `config.fresh` become landmarks.

    Correspondences are integers: derivatives are those of the filter with correspondences fixed.

    Args:
        config: Static configuration.
        noise: Standard deviations of odometry and features.
        belief: Belief after the step before.
        inputs: Odometry increment and features of this step.

    Raises:
        ValueError: `inputs.known` has another shape or type than the features, or there is scan
            matching and `noise.alignment` is None; while tracing.

    References:
        Paper, section 3, eqs. (1)-(16). Thrun, Burgard, Fox (2005), Probabilistic Robotics,
        chapter 10.
    """
    is_known = inputs.known is not None
    if is_known:
        config = config._replace(confirm=1, wall_confirm=1)
    features, features_cov = _select(config, noise, inputs.nodes)
    predicted = _predict(config, noise, belief, inputs)
    found = _associate(config, predicted, features, features_cov, inputs.known)
    matches = _choose(config, predicted, features, found.slot)
    chosen, rows = _linearise(config, predicted, features, features_cov, matches)
    if not is_known:
        predicted, rows, matches = _verify(config, predicted, chosen, rows, matches)
    updated, result, matches = _update(config, predicted, rows, matches)
    tracked, pruned, merged = _manage_tracks(config, updated, features, matches, is_known)
    found = found._replace(new=found.new & result.good)
    mapped, new_slot, evicted = _add_landmarks(config, tracked, features, features_cov, found)
    info = _step_info(
        mapped, features, matches, new_slot, result, pruned=pruned, merged=merged, evicted=evicted
    )
    return mapped, info


def _select(config: Config, noise: Noise, features: Nodes) -> tuple[Nodes, Array]:
    """Features of the configured kinds, and their measurement covariance R (M, 2, 2)."""
    allowed = jnp.isin(features.kind, jnp.array(config.kinds, jnp.int32))
    features = nodes.restrict(features, allowed)
    return features, sensor_noise(noise, features, doubt=config.doubt)


def _predict(config: Config, noise: Noise, belief: Belief, inputs: Inputs) -> Belief:
    """Predict by the odometry increment, and count the step."""
    motion, motion_cov = moved(noise, inputs)
    belief = ekf.predict(belief, motion, motion_cov, linearisation=config.linearisation)
    return belief._replace(step=belief.step + 1)


def _associate(
    config: Config, belief: Belief, features: Nodes, features_cov: Array, known: Array | None
) -> Recognised:
    """Associate features with landmarks, by known ids where they are given."""
    if known is not None:
        return identify(belief, features, known)
    return recognise(config.matching, belief, features, features_cov)


def _choose(config: Config, belief: Belief, features: Nodes, slot: Array) -> _Matches:
    """Choose the matches that update the state, no more than `config.matches`.

    Only landmarks that this observation confirms, or that are confirmed already, are used. Wall
    directions come first, then the order of the front end.
    """
    size = belief.seen.size
    observations = belief.seen.at[slot].get(mode="fill", fill_value=0) + 1
    used = (slot < size) & (observations >= needed(config, features.kind))
    priority = jnp.where(used, jnp.where(features.kind == WALL, 2, 1), 0)
    order = jnp.argsort(-priority, stable=True)[: config.matches]
    used &= jnp.zeros_like(used).at[order].set(True)
    return _Matches(slot, used, order)


def _linearise(
    config: Config, belief: Belief, features: Nodes, features_cov: Array, matches: _Matches
) -> tuple[Nodes, Rows]:
    """Features (K) of the rows of the update, and their innovations with Jacobians."""
    used_slot = jnp.where(matches.used, matches.slot, belief.seen.size)
    chosen, chosen_cov, chosen_slot = jax.tree.map(
        lambda field: field[matches.order], (features, features_cov, used_slot)
    )
    rows = ekf.innovations(
        belief, chosen, chosen_cov, chosen_slot, linearisation=config.linearisation
    )
    return chosen, rows


def _verify(
    config: Config, belief: Belief, chosen: Nodes, rows: Rows, matches: _Matches
) -> tuple[Belief, Rows, _Matches]:
    """Drop the matches that `second_look` rejects.

    Returns:
        The belief with its counts of matches not yet accepted, the rows and the matches that are
        left. A rejected match does not count as an observation of its landmark, either.
    """
    joint_cov = lax.stop_gradient(innovation_cov(ekf.blocks(belief), rows))
    accepted, looks = second_look(config.matching, belief, chosen, rows, joint_cov)
    rows, belief = drop(rows, accepted), belief._replace(looks=looks)
    slot, used, order = matches
    rejected = used & jnp.zeros_like(used).at[order].set(~accepted)
    slot = jnp.where(rejected, belief.seen.size, slot)
    return belief, rows, _Matches(slot, used & ~rejected, order)


def _update(
    config: Config, belief: Belief, rows: Rows, matches: _Matches
) -> tuple[Belief, Conditioned, _Matches]:
    """Update by all rows at once, unless the result is not finite.

    Returns:
        The belief, the result of the update, and the matches. Where the updated mean is not finite,
        `result.good` is False and no match is left. An update that fails changes no covariance, so
        only the mean is restored.
    """
    updated, result = ekf.update(belief, rows, linearisation=config.linearisation)
    finite = jnp.all(jnp.isfinite(updated.mean)) & result.good
    updated = updated._replace(mean=jnp.where(finite, updated.mean, belief.mean))
    slot = jnp.where(finite, matches.slot, belief.seen.size)
    matches = matches._replace(slot=slot, used=matches.used & finite)
    return updated, result._replace(good=finite), matches


def _manage_tracks(
    config: Config, belief: Belief, features: Nodes, matches: _Matches, is_known: bool
) -> tuple[Belief, Array, Array]:
    """Record the observations, prune landmarks that are not there, merge duplicates.

    Where correspondences are known, observations are recorded only. Of the landmarks that updated
    the state one is checked for a duplicate, in turn: row `step % K` of the update.

    Returns:
        The belief, and the numbers () int32 of pruned landmarks and of merged duplicates.
    """
    belief = note(belief, features, matches.slot)
    if is_known:
        return belief, jnp.int32(0), jnp.int32(0)
    used_slot = jnp.where(matches.used, matches.slot, belief.seen.size)[matches.order]
    belief, pruned = _prune(config, belief, jnp.any(features.valid))
    belief, merged = _merge_duplicate(config, belief, used_slot[belief.step % used_slot.size])
    return belief, pruned, merged


def _prune(config: Config, belief: Belief, any_feature: Array) -> tuple[Belief, Array]:
    """Prune landmarks that stay unconfirmed, and junctions whose detection is missed repeatedly.

    Args:
        config: Static configuration.
        belief: Updated belief, with the observations of this step recorded.
        any_feature: () bool; a scan without any feature is no evidence that a junction is gone.

    Returns:
        The belief, and the number () int32 of pruned landmarks.
    """
    lidar = config.lidar
    view = lidar.first, lidar.first + lidar.step * (lidar.beams - 1)
    missed = overdue(belief, view) & (belief.last < belief.step) & any_feature
    belief = belief._replace(missed=jnp.where(missed, belief.missed + 1, belief.missed))
    pruned = ~confirmed(config, belief) & (belief.step - belief.last > config.patience)
    pruned = (pruned | (belief.missed >= config.misses)) & (belief.seen > 0)
    return forget(belief, pruned), jnp.sum(pruned, dtype=jnp.int32)


def _merge_duplicate(config: Config, belief: Belief, slot: Array) -> tuple[Belief, Array]:
    """Merge a landmark (slot (), L for none) with its duplicate, if any; the older id stays.

    Returns:
        The belief, and the number () int32 of merged duplicates.
    """
    size = belief.seen.size
    duplicate = twin(config.matching, belief, slot)
    no_id = jnp.iinfo(jnp.int32).max
    duplicate_id = belief.id.at[duplicate].get(mode="fill", fill_value=no_id)
    own_id = belief.id.at[slot].get(mode="fill", fill_value=no_id)
    is_older = duplicate_id < own_id
    keep = jnp.where(is_older, duplicate, slot)
    merged = jnp.where(is_older, slot, duplicate)
    belief = ekf.merge(belief, jnp.minimum(keep, size - 1), merged)
    return belief, (duplicate < size).astype(jnp.int32)


def _add_landmarks(
    config: Config, belief: Belief, features: Nodes, features_cov: Array, found: Recognised
) -> tuple[Belief, Array, Array]:
    """Add the new features to the map; a full map evicts unconfirmed landmarks for them.

    Returns:
        The belief, the slot (M,) int32 of each new landmark (L for none), and the number () int32
        of evicted ones.
    """
    cost = worth(belief, confirmed(config, belief), idle=config.idle)
    mapped, new_slot = ekf.augment(
        belief,
        features,
        features_cov,
        found.new,
        most=config.fresh,
        at=found.at,
        worth=cost,
        linearisation=config.linearisation,
    )
    replaced = belief.seen.at[new_slot].get(mode="fill", fill_value=0) > 0
    return mapped, new_slot, jnp.sum(replaced, dtype=jnp.int32)


def _step_info(
    belief: Belief,
    features: Nodes,
    matches: _Matches,
    new_slot: Array,
    result: Conditioned,
    *,
    pruned: Array,
    merged: Array,
    evicted: Array,
) -> Info:
    """Diagnostics of the step; the likelihood of an update that was left out is zero."""
    size = belief.seen.size
    slot = jnp.minimum(matches.slot, new_slot)
    degrees = jnp.where(features.kind == WALL, 1, 2)
    dof = jnp.sum(jnp.where(matches.used, degrees, 0), dtype=jnp.int32)
    return Info(
        pose=belief.pose,
        pose_cov=belief.pose_cov,
        slot=slot,
        id=belief.id.at[slot].get(mode="fill", fill_value=-1),
        used=matches.used,
        nis=jnp.where(result.good, result.nis, 0.0),
        dof=dof,
        log_likelihood=jnp.where(result.good, log_likelihood(result, dof), 0.0),
        finite=result.good,
        fresh=jnp.sum(new_slot < size, dtype=jnp.int32),
        forgotten=pruned,
        evicted=evicted,
        merged=merged,
    )


@partial(jax.jit, static_argnames="config")
def run(config: Config, noise: Noise, start: Belief, inputs: Inputs) -> tuple[Belief, Info]:
    """Run the filter over one log.

    For a derivative, only the rows of the covariance that each step touched are kept, never the
    whole. Derivatives are taken in reverse mode only (`conditioning.condition`).

    Args:
        config: Static configuration.
        noise: Standard deviations of odometry and features.
        start: Belief before the first step.
        inputs: [T] measurements.

    Returns:
        The belief after the last step, and the diagnostics [T].
    """

    def body(belief: Belief, now: Inputs) -> tuple[Belief, Info]:
        return step(config, noise, belief, now)

    return lax.scan(body, start, inputs)


@partial(programs.jit, static_argnames="config")
def local_maps(config: Config, scans: Scan) -> tuple[Nodes, Links]:
    """`local_map` of scans [T], `BATCH` at a time to bound memory."""
    return map_batches(partial(local_map, config), scans, size=BATCH)
