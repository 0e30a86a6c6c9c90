"""Local topological map of one scan on all levels of the pyramid.

An arc, or frontier, belongs to the finest level that can hold it: a coarser level adds those that
end at one of its own junctions, or whose ids meet where the finer levels do not reach. A branch
that leaves the finest grid is a frontier there, at its edge; a coarser level continues it, from
the same junction, and then replaces it:

        level 0:   junction o-------------| edge of the grid: a frontier
        level 1:   junction o-----------------------------------o junction: an arc instead
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import FAR_JUNCTION, Array
from jaxslam.frontend.automaton import Diagram
from jaxslam.frontend.features import FeatureSpec
from jaxslam.frontend.local_graph import (
    MAX_LOCAL_ARCS,
    MAX_LOCAL_FRONTIERS,
    SAME_ARC_DISTANCE,
    CoarseOnly,
    LocalArcs,
    find_local_arcs,
    repeats_earlier,
)
from jaxslam.frontend.pyramid import Level, beyond_finer, largest_radius

CONTINUED_WITHIN = 2.0
"""[cells of the coarser level] Largest distance of a frontier's end from what continues it."""


def find_pyramid_arcs(
    lidar: Lidar,
    levels: Sequence[Level],
    spec: FeatureSpec,
    features: Features,
    diagrams: Sequence[tuple[Diagram, Array]],
    scan: Scan,
) -> LocalArcs:
    """`find_local_arcs` on all levels, put together.

    Of two arcs with the same ends that run side by side the one of the finer level is kept. Arcs
    and frontiers of coarser levels take the slots that the finer ones leave.

    Args:
        lidar: The scanner.
        levels: The levels, the finest first.
        spec: Capacities; at most 31 junctions.
        features: Features of the scan, junctions first.
        diagrams: Voronoi diagram and source cells (H, W) bool of each level.
        scan: The scan.

    Returns:
        `MAX_LOCAL_ARCS` arcs, then `MAX_LOCAL_FRONTIERS` frontiers; robot frame.

    Raises:
        ValueError: As of `find_local_arcs`.
    """
    arcs = find_local_arcs(lidar, levels[0].grid, spec, features, *diagrams[0], scan)
    x, y = features.xy[: spec.max_junctions].T
    radius = features.descriptor[: spec.max_junctions]
    far = jnp.ones(radius.shape, bool)
    for k in range(1, len(levels)):
        finer, level = levels[k - 1], levels[k]
        far &= radius > largest_radius(x, y, finer, level)
        wanted = CoarseOnly(beyond_finer(diagrams[k][0].arrival, level, finer), far)
        added = find_local_arcs(lidar, level.grid, spec, features, *diagrams[k], scan, wanted)
        arcs = _add(arcs, added, level, features.kind == FAR_JUNCTION)
    return arcs


def _add(arcs: LocalArcs, added: LocalArcs, level: Level, is_far: Array) -> LocalArcs:
    """The arcs and frontiers of the finer levels, and those that a coarser level adds.

    Args:
        arcs: Those of the finer levels.
        added: Those of the coarser level.
        level: That level.
        is_far: (M,) bool, features that are far junctions.
    """
    to_far = jnp.any((added.pair >= 0) & is_far[added.pair], axis=1)
    longer = added._replace(valid=added.valid & ~to_far)
    arcs = arcs._replace(valid=arcs.valid & ~_continued(arcs, longer, level))
    both = jax.tree.map(lambda *x: jnp.concatenate(x), arcs, added)
    coarse = np.arange(len(both.valid))[:, None] >= len(arcs.valid)
    apart = np.where(coarse, SAME_ARC_DISTANCE * level.scale, SAME_ARC_DISTANCE)
    valid = both.valid & ~repeats_earlier(
        both.pair, both.polyline, both.valid, jnp.asarray(apart, both.length.dtype)
    )
    is_frontier = np.tile(np.arange(len(arcs.valid)) >= MAX_LOCAL_ARCS, 2)
    rows = []
    for kind, count in ((~is_frontier, MAX_LOCAL_ARCS), (is_frontier, MAX_LOCAL_FRONTIERS)):
        own = jnp.asarray(np.flatnonzero(kind), jnp.int32)
        rows.append(own[jnp.argsort(~valid[own], stable=True)[:count]])
    chosen = jnp.concatenate(rows)
    return jax.tree.map(lambda x: x[chosen], both._replace(valid=valid))


def _continued(arcs: LocalArcs, added: LocalArcs, level: Level) -> Array:
    """Frontiers (P,) bool at whose end a branch of the coarser level goes on, from their junction.

    The distance of the end of the frontier from the polyline of the branch decides, and whether
    that is longer.
    """
    end = arcs.polyline[:, None, None, -1]  # (P, 1, 1, 2)
    start, step = added.polyline[None, :, :-1], jnp.diff(added.polyline, axis=1)[None]
    along = jnp.sum((end - start) * step, axis=-1) / jnp.maximum(jnp.sum(step**2, axis=-1), 1e-9)
    nearest = start + jnp.clip(along, 0.0, 1.0)[..., None] * step
    distance = jnp.min(jnp.linalg.norm(end - nearest, axis=-1), axis=-1)  # (P, P)
    same_junction = jnp.any(added.pair[None] == arcs.pair[:, None, :1], axis=2)
    goes_on = same_junction & (distance < CONTINUED_WITHIN * level.grid.cell_size)
    goes_on &= added.valid[None] & (added.length[None] > arcs.length[:, None])
    return (arcs.pair[:, 1] < 0) & jnp.any(goes_on, axis=1)
