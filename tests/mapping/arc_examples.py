"""Small local arcs, arc tables and beliefs, and what is in them."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core import polylines
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import inverse_transform
from jaxslam.filtering.belief import initial_belief
from jaxslam.frontend.arc_tracing import POLYLINE_POINTS
from jaxslam.frontend.local_graph import LocalArcs
from jaxslam.mapping import arc_table

HERE = jnp.zeros(3)
THERE = jnp.array([2.0, -1.0, 2.2])
LIDAR = Lidar(num_beams=91, angle_increment=np.pi / 90)
BLIND = Scan(jnp.full(91, 0.1), jnp.ones(91, bool))  # sees nothing free
POSITIONS = np.stack([3.0 * np.arange(12), np.arange(12) ** 2 / 4], axis=1)  # [m] of features, map

_add = jax.jit(arc_table.add_scan_arcs, static_argnums=0)


def add(arcs, ids, pose, local_arcs, scan=BLIND):
    return _add(LIDAR, arcs, ids, pose, local_arcs, scan)


def curve(a, b, bulge=0.0):
    """Line (K, 2) from `a` to `b`, `bulge` [m] to the left of the chord in the middle."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    fraction = np.linspace(0, 1, 50)[:, None]
    side = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
    return polylines.resample(
        a + fraction * (b - a) + bulge * np.sin(np.pi * fraction) * side, POLYLINE_POINTS
    )


def local_arcs_of(*found, size=4, junk=0.0, pose=HERE):
    """Local arcs in the frame of `pose`, padded to `size` with junk.

    Each of `found` is (i, j, clearance, bulge, or end of a frontier if j is -1), with feature i at
    POSITIONS[i].
    """
    pair = np.zeros((size, 2), int)
    line, clearance = np.full((size, POLYLINE_POINTS, 2), junk), np.full(size, junk)
    for k, (i, j, narrowest, *more) in enumerate(found):
        pair[k], clearance[k] = (i, j), narrowest
        line[k] = curve(POSITIONS[i], *more) if j < 0 else curve(POSITIONS[i], POSITIONS[j], *more)
    return LocalArcs(
        pair=jnp.array(pair, jnp.int32),
        polyline=inverse_transform(pose, jnp.asarray(line)),
        length=jnp.asarray(polylines.length(line)),
        clearance=jnp.asarray(clearance),
        valid=jnp.arange(size) < len(found),
    )


def ids(*known):
    """Landmarks of 12 features, none of those not given."""
    return jnp.array([*known, *[-1] * (12 - len(known))], jnp.int32)


def used_slots(arcs):
    """Content of the slots in use: (ends, clearance, number of observations), sorted."""
    used = np.flatnonzero(arcs.num_seen)
    table = [(tuple(np.asarray(arcs.ends)[k].tolist()), float(arcs.clearance[k])) for k in used]
    return sorted((*row, int(arcs.num_seen[k])) for row, k in zip(table, used, strict=True))


def arcs_of(*found):
    """Map of arcs (ends, line), observed once each."""
    arcs = jax.tree.map(np.array, arc_table.empty_arcs(capacity=12))
    for k, (ends, line) in enumerate(found):
        arcs.ends[k], arcs.polyline[k], arcs.num_seen[k] = ends, line, 1
        arcs.length[k] = polylines.length(line)
    return arcs


def belief_of(xy, kind, seen, ids=None, descriptor=None):
    """Belief with landmarks in known states."""
    size = len(kind)
    belief = initial_belief(HERE, max_landmarks=size)
    return belief._replace(
        mean=belief.mean.at[3:].set(jnp.array(xy, float).reshape(-1)),
        kind=jnp.array(kind, jnp.int32),
        num_seen=jnp.array(seen, jnp.int32),
        id=jnp.array(np.arange(size) if ids is None else ids, jnp.int32),
        descriptor=jnp.ones(size) if descriptor is None else jnp.array(descriptor, float),
    )
