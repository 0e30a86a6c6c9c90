"""SLAM of one robot: scan to features, one step of the filter, a log of features.

`step` is the only place where front end and filter meet.
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
from jaxslam.conditioning import drop, innovation_cov, log_likelihood
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
from jaxslam.recognition import MatchSpec, identify, overdue, recognise, second_look, twin
from jaxslam.types import CORNER, NODE, WALL, Array

BATCH = 16  # scans that are looked at together


class Config(NamedTuple):
    """Everything that fixes shapes or decides; hashable, static under jit."""

    lidar: Lidar = Lidar()
    grid: GridSpec = GridSpec()
    runs: RunSpec = RunSpec()
    nodes: NodeSpec = NodeSpec()
    labels: str = "runs"  # or "codes", the paper's
    kinds: tuple[int, ...] = (NODE, CORNER, WALL)  # landmarks the filter uses
    steps: int = 32  # of the automaton
    linearisation: str = "standard"  # the paper's, or another of `ekf.LINEARISATIONS`
    landmarks: int = 96  # L
    matches: int = 8  # landmarks that update the state in one scan at most
    fresh: int = 8  # new landmarks in one scan at most
    matching: MatchSpec = MatchSpec()
    alignment: AlignSpec = AlignSpec()  # of scans, where odometry is taken from them
    closures: ClosureSpec = ClosureSpec()  # of loops, where such a drive is smoothed
    doubt: float = 3.0  # factor on the standard deviation of features that are not trusted
    confirm: int = 2  # sightings from which a landmark counts
    wall_confirm: int = 4  # likewise a wall direction: most scans show one, and a wrong one harms
    patience: int = 40  # steps after which an unconfirmed one is dropped
    idle: int = 5  # and after which it makes room where the map is full
    misses: int = 10  # steps in a row in which a node in plain sight was not seen; then it is gone


class Inputs(NamedTuple):
    """What the filter is given at a step."""

    motion: Array  # (3,) odometry since the scan before
    nodes: Nodes  # features of this scan
    known: Array | None = None  # (M,) int32 landmark 0..L-1 each feature is, -1 unknown; or match
    aligned: Aligned | None = None  # the same motion by scans, to be fused with the odometry


class Info(NamedTuple):
    """What is worth knowing of a step; the next one does not need it."""

    pose: Array  # (3,)
    pose_cov: Array  # (3, 3)
    slot: Array  # (M,) int32 slot of each feature, matched or new; L for none
    id: Array  # (M,) int32 its landmark's id, -1 for none
    used: Array  # (M,) bool, the feature updated the state
    nis: Array  # () squared Mahalanobis norm of the innovations
    dof: Array  # () int32 and their number
    log_likelihood: Array  # () [nats] of the innovations
    finite: Array  # () bool, False where the update had to be left out
    fresh: Array  # () int32 features that were taken in as new landmarks
    forgotten: Array  # () int32 landmarks and candidates that were forgotten
    evicted: Array  # () int32 candidates that made room for others in a full map
    merged: Array  # () int32 landmarks that were found to be another


def front_end(config: Config, scan: Scan) -> Nodes:
    """Landmarks of one scan, robot frame."""
    return look(config, scan)[0]


def start_of(run: Array, open: Array) -> Array:
    """Cells (H, W) int8 that fronts start from: runs (H, W) int8, and what they may enter."""
    empty = jnp.where(open, voronoi.EMPTY, voronoi.SHUT).astype(jnp.int8)
    return jnp.where(run >= 0, run, empty)


def look(config: Config, scan: Scan) -> tuple[Nodes, voronoi.Diagram, Array]:
    """Landmarks of one scan, with the diagram they came from and its source cells (H, W)."""
    lidar, spec = config.lidar, config.grid
    runs = edges.runs(scan, lidar, config.runs)
    if config.labels == "codes":
        grid = rasterise(scan, lidar, spec)
        labels = edges.code_bits(edges.codes(grid, spec))
        start = voronoi.number(labels, grid.free)
        sources = grid.occupied
    else:
        run = edges.run_cells(scan, lidar, runs, spec)
        sources = run >= 0
        labels = jnp.where(sources, jnp.uint32(1) << jnp.maximum(run, 0).astype(jnp.uint32), 0)
        start = start_of(run, seen_free(scan, lidar, spec))
    octagon = config.labels == "runs"  # the paper's fronts are diamonds
    fronts = voronoi.grow(start, steps=config.steps, octagon=octagon)
    diagram = voronoi.gather(labels, fronts, octagon=octagon)
    cells = voronoi.crowded(fronts, sources)
    found = nodes.join(
        junctions.find_junctions(cells, scan, runs, lidar, spec, config.nodes),
        nodes.find_corners(runs, config.nodes),
        nodes.find_walls(runs, config.nodes),
    )
    return found, diagram, sources


def local_map(config: Config, scan: Scan) -> tuple[Nodes, Links]:
    """Local topological map of one scan: its landmarks and the arcs between its junctions."""
    found, diagram, sources = look(config, scan)
    joined = links.find_links(
        found, diagram, sources, scan, config.lidar, config.grid, config.nodes
    )
    return found, joined


def init(config: Config, pose: Array, cov: Array | None = None) -> Belief:
    """Belief of a robot that starts at a pose (3,) with an empty map.

    Args:
        config: Of the filter.
        pose: World frame.
        cov: (3, 3) covariance of the pose; zero by default, as the map has no other origin.

    Raises:
        ValueError: The covariance is not symmetric and positive semi-definite.
    """
    return initial(pose, landmarks=config.landmarks, cov=cov)


def needed(config: Config, kind: Array) -> Array:
    """Sightings (...) from which landmarks of these kinds (...) count."""
    return jnp.where(kind == WALL, config.wall_confirm, config.confirm)


def confirmed(config: Config, belief: Belief) -> Array:
    """Landmarks (L,) bool that count."""
    return belief.seen >= needed(config, belief.kind)


def _outlive(
    config: Config, belief: Belief, slot: Array, looked: Array
) -> tuple[Belief, Array, Array]:
    """Forget what is not there, and merge two landmarks that are one.

    Args:
        config: Of the filter.
        belief: Updated, sightings noted.
        slot: (M,) int32 landmarks that updated it, L for none; one of them is looked at, in turn.
        looked: () bool; a scan in which nothing at all was found says of nothing that it is gone.

    Returns:
        The belief, and the numbers () of forgotten and of merged landmarks.
    """
    lidar, size = config.lidar, belief.seen.size
    view = lidar.first, lidar.first + lidar.step * (lidar.beams - 1)
    due = overdue(belief, view) & (belief.last < belief.step) & looked
    belief = belief._replace(missed=jnp.where(due, belief.missed + 1, belief.missed))
    gone = ~confirmed(config, belief) & (belief.step - belief.last > config.patience)
    gone = (gone | (belief.missed >= config.misses)) & (belief.seen > 0)
    belief = forget(belief, gone)
    one = slot[belief.step % slot.size]
    other = twin(config.matching, belief, one)
    # The older name stays.
    name = lambda at: belief.id.at[at].get(mode="fill", fill_value=jnp.iinfo(jnp.int32).max)
    swap = name(other) < name(one)
    keep, drop = jnp.where(swap, other, one), jnp.where(swap, one, other)
    merged = (other < size).astype(jnp.int32)
    belief = ekf.merge(belief, jnp.minimum(keep, size - 1), drop)
    return belief, jnp.sum(gone, dtype=jnp.int32), merged


def moved(noise: Noise, inputs: Inputs) -> tuple[Array, Array]:
    """Motion (3,) since the step before, and its covariance (3, 3) in the frame of that pose.

    Raises:
        ValueError: A motion is aligned, and `noise.alignment` is None; while tracing.
    """
    q = process_noise(noise.odometry, inputs.motion)
    if inputs.aligned is None:
        return inputs.motion, q
    if noise.alignment is None:
        raise ValueError("noise.alignment is None, and there are aligned motions")
    return alignment.fuse(inputs.motion, q, inputs.aligned, noise.alignment)


def step(config: Config, noise: Noise, belief: Belief, inputs: Inputs) -> tuple[Belief, Info]:
    """Predict by odometry, match, update, take in new landmarks.

    Matches are integers: derivatives are those of the filter with its matches held fixed. With
    `inputs.known` nothing is matched, and all landmarks count from their first sighting for ever.
    No more than `config.matches` features update the state in a step, and `config.fresh` are new.

    Raises:
        ValueError: `inputs.known` has another shape or type than the features; while tracing.
    """
    size = belief.seen.size
    allowed = jnp.isin(inputs.nodes.kind, jnp.array(config.kinds, jnp.int32))
    seen = nodes.restrict(inputs.nodes, allowed)
    how = {"linearisation": config.linearisation}
    before = ekf.predict(belief, *moved(noise, inputs), **how)._replace(step=belief.step + 1)
    r = sensor_noise(noise, seen, doubt=config.doubt)

    if inputs.known is None:
        features = recognise(config.matching, before, seen, r)
    else:
        features = identify(before, seen, inputs.known)
        config = config._replace(confirm=1, wall_confirm=1)  # it counts at once, and for ever
    slot = features.slot
    sightings = before.seen.at[slot].get(mode="fill", fill_value=0) + 1
    used = (slot < size) & (sightings >= needed(config, seen.kind))
    # A few rows suffice: wall directions first, then as the front end ordered them.
    urgency = jnp.where(used, jnp.where(seen.kind == WALL, 2, 1), 0)
    order = jnp.argsort(-urgency, stable=True)[: config.matches]
    used &= jnp.zeros_like(used).at[order].set(True)
    some = jax.tree.map(lambda x: x[order], (seen, r, jnp.where(used, slot, size)))
    rows = ekf.innovations(before, *some, **how)
    if inputs.known is None:
        s = lax.stop_gradient(innovation_cov(ekf.blocks(before), rows))
        believed, looks = second_look(config.matching, before, some[0], rows, s)
        rows, before = drop(rows, believed), before._replace(looks=looks)
        doubted = used & jnp.zeros_like(used).at[order].set(~believed)
        used, slot = used & ~doubted, jnp.where(doubted, size, slot)
    after, done = ekf.update(before, rows, **how)
    finite = jnp.all(jnp.isfinite(after.mean)) & done.good
    # A conditioning that fails changes no covariance.
    after = after._replace(mean=jnp.where(finite, after.mean, before.mean))
    slot, used = jnp.where(finite, slot, size), used & finite
    after = note(after, seen, slot)
    if inputs.known is None:
        matched = jnp.where(used, slot, size)[order]
        after, forgotten, merged = _outlive(config, after, matched, jnp.any(seen.valid))
    else:
        forgotten = merged = jnp.int32(0)
    held = after.seen
    after, fresh = ekf.augment(
        after,
        seen,
        r,
        features.new & finite,
        most=config.fresh,
        at=features.at,
        worth=worth(after, confirmed(config, after), idle=config.idle),
        **how,
    )
    evicted = jnp.sum(held.at[fresh].get(mode="fill", fill_value=0) > 0, dtype=jnp.int32)

    slot = jnp.minimum(slot, fresh)
    rank = jnp.where(seen.kind == WALL, 1, 2)
    dof = jnp.sum(jnp.where(used, rank, 0), dtype=jnp.int32)
    info = Info(
        pose=after.pose,
        pose_cov=after.pose_cov,
        slot=slot,
        id=after.id.at[slot].get(mode="fill", fill_value=-1),
        used=used,
        nis=jnp.where(finite, done.nis, 0.0),
        dof=dof,
        log_likelihood=jnp.where(finite, log_likelihood(done, dof), 0.0),
        finite=finite,
        fresh=jnp.sum(fresh < size, dtype=jnp.int32),
        forgotten=forgotten,
        evicted=evicted,
        merged=merged,
    )
    return after, info


@partial(jax.jit, static_argnames="config")
def run(config: Config, noise: Noise, start: Belief, inputs: Inputs) -> tuple[Belief, Info]:
    """Filter one log: `inputs` leads with T, and so does the info.

    A derivative keeps of each step the rows of the covariance that it touched, never the whole.
    It is taken in reverse only (`conditioning.condition`).
    """

    def body(belief: Belief, now: Inputs) -> tuple[Belief, Info]:
        return step(config, noise, belief, now)

    return lax.scan(body, start, inputs)


@partial(programs.jit, static_argnames="config")
def local_maps(config: Config, scans: Scan) -> tuple[Nodes, Links]:
    """`local_map` of scans that lead with T, a few at a time, which bounds memory."""
    return map_batches(partial(local_map, config), scans, size=BATCH)
