"""The local topological map of one scan: which of its junctions the branches join."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.grid import GridSpec, centre_of, centres
from jaxslam.lidar import Lidar, Scan, points
from jaxslam.nodes import Nodes, NodeSpec
from jaxslam.types import Array
from jaxslam.voronoi import Diagram, around, block_union, branches, expand, single

LINK_STEPS = 60  # steps that the ids of two junctions take to meet at most


class Links(NamedTuple):
    """Branches of one diagram that join two of its junctions, padded to P; robot frame."""

    pair: Array  # (P, 2) int32 indices of the features they join
    via: Array  # (P, 2) [m] a point half-way
    clearance: Array  # (P,) [m] the smaller of that point and of both ends
    valid: Array  # (P,) bool


def find_links(
    found: Nodes,
    diagram: Diagram,
    sources: Array,
    scan: Scan,
    lidar: Lidar,
    grid: GridSpec,
    spec: NodeSpec,
) -> Links:
    """Which junctions the branches of a diagram join.

    The ids of the junctions expand along the branches, by the same automaton as the fronts before;
    where two ids meet, an arc is found.

    Args:
        found: Features of the scan, junctions first.
        diagram: Its diagram.
        sources: (H, W) bool, the cells the fronts came from.
        scan: The scan.
        lidar: The scanner.
        grid: The grid of the diagram.
        spec: Capacities; at most seven junctions, the bits of a uint8.
    """
    count = spec.nodes
    place, valid = found.xy[:count], found.valid[:count]
    middle = centres(grid).astype(place.dtype)
    near = jnp.linalg.norm(middle[None] - place[:, None, None], axis=-1) < 2.5 * grid.cell
    near &= valid[:, None, None]  # (N, H, W)
    bit = jnp.uint8(1) << jnp.arange(count, dtype=jnp.uint8)
    seeds = jnp.zeros(grid.shape, jnp.uint8)
    for k in range(count):
        seeds |= jnp.where(near[k], bit[k], jnp.uint8(0))
    branch = branches(diagram, sources).astype(jnp.uint8)
    thick = (block_union(branch) > 0) & (diagram.labels != 0) & ~sources
    met = expand(seeds, thick | (seeds != 0), steps=LINK_STEPS)
    ids, when = met.labels, jnp.where(met.arrival >= 0, met.arrival, LINK_STEPS + 1)
    # An even meet: one id here, another next door.
    beside = jnp.zeros_like(ids)
    for other in around(single(ids)):
        beside |= other
    both = ids | jnp.where(single(ids) != 0, beside, jnp.uint8(0))

    first, second = np.triu_indices(count, 1)
    hits = points(scan, lidar)

    def link(i: Array, j: Array) -> tuple[Array, Array, Array]:
        want = bit[i] | bit[j]
        here = jnp.where(both & want == want, when, LINK_STEPS + 1).reshape(-1)
        at = jnp.argmin(here)
        via = centre_of(jnp.stack([at // grid.shape[1], at % grid.shape[1]]), grid)
        via = via.astype(place.dtype)
        away = jnp.linalg.norm(hits - via[None], axis=1)
        room = jnp.min(jnp.where(scan.hit, away, jnp.inf))
        room = jnp.minimum(room, jnp.minimum(found.shape[i], found.shape[j]))
        return via, room, (here[at] <= LINK_STEPS) & valid[i] & valid[j]

    via, room, joined = jax.vmap(link)(jnp.asarray(first), jnp.asarray(second))
    pair = jnp.stack([jnp.asarray(first), jnp.asarray(second)], axis=1).astype(jnp.int32)
    return Links(pair=pair, via=via, clearance=room, valid=joined)
