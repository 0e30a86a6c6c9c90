"""Two other methods of place recognition, on the queries of `place_recognition`.

**Search**: a correlative search without hypotheses. All poses of a grid around the positions of the
index, 0.2 m and 3 degrees apart, are scored by the distances of the points from the walls of the
map. It gives a pose, not refined, and the margin to the best one at another place.

**Landmark pairs**: histograms of the directions and distances of all pairs of landmarks of a scan,
the junctions and corners of the front end; a query is compared with each keyframe, at the best
circular shift of the directions, since the heading is unknown. It gives the nearest keyframe, no
pose. Written from the papers, without their keypoints and their index for approximate neighbours.

References:
    Olson (2009), Real-time correlative scan matching. Himstedt, Frost, Hellbach, Boehme, Maehle
    (2014), Large scale place recognition in 2D LIDAR scans using geometrical landmark relations
    (GLARE). Kallasi, Rizzini (2016), Efficient loop closure based on FALKO lidar features (GLAROT:
    the circular shift).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.features import Features
from jaxslam.core.se2 import rotation, wrap_angle
from jaxslam.core.types import WALL, Array
from jaxslam.matching.place_fit import PlaceQuery
from jaxslam.matching.place_index import PlaceIndex, PlaceSpec

NUM_HEADINGS = 120
SEARCH_STD = 0.15  # [m] of a point's distance from a wall, about that of poses from the grid
POINT_STEP = 2  # every second point of a query
DIRECTIONS = 24  # bins of half a turn: a pair has no order
PAIR_STEP, PAIR_MAX = 0.5, 15.0  # [m] bin and largest distance of a pair


class Answer(NamedTuple):
    """What a search found: pose (3,), its score (), and its margin () to any other place."""

    pose: Array
    score: Array
    margin: Array


@partial(jax.jit, static_argnums=0)
def search_everywhere(spec: PlaceSpec, index: PlaceIndex, query: PlaceQuery) -> Answer:
    """The best pose of all positions of the index and all headings."""
    likelihood = jnp.exp(-0.5 * (index.distance / SEARCH_STD) ** 2)
    height, width = likelihood.shape
    points, valid = query.points[::POINT_STEP], query.valid[::POINT_STEP]
    count = jnp.maximum(jnp.sum(valid, dtype=points.dtype), 1.0)
    quarter = spec.position_spacing / 4  # each position of the index stands for four
    offsets = quarter * jnp.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    positions = (index.positions[:, None] + offsets[None]).reshape(-1, 2)
    exists = jnp.repeat(index.valid, len(offsets))
    starts = positions - index.origin[None]

    def at_heading(heading: Array) -> Array:
        ends = starts[:, None] + (points @ rotation(heading).T)[None]
        cell = jnp.round(ends / spec.cell).astype(jnp.int32)
        found = likelihood[cell[..., 0].clip(0, height - 1), cell[..., 1].clip(0, width - 1)]
        return jnp.sum(jnp.where(valid[None], found, 0.0), axis=1) / count

    headings = jnp.asarray(2 * np.pi / NUM_HEADINGS * np.arange(NUM_HEADINGS), points.dtype)
    scores = jnp.where(exists[None], lax.map(at_heading, headings), -jnp.inf)
    best = jnp.argmax(scores)
    heading, position = headings[best // len(starts)], positions[best % len(starts)]
    near = jnp.linalg.norm(positions - position[None], axis=1) < spec.distinct[0]
    same = near[None] & (jnp.abs(wrap_angle(headings - heading)) < spec.distinct[1])[:, None]
    score = scores.ravel()[best]
    margin = score - jnp.max(jnp.where(same, -jnp.inf, scores))
    return Answer(jnp.append(position, wrap_angle(heading)), score, margin)


def pair_histogram(points: np.ndarray) -> np.ndarray:
    """Histogram (directions, distances) of all pairs of points (M, 2) [m]; it adds up to one."""
    bins = int(PAIR_MAX / PAIR_STEP)
    histogram = np.zeros((DIRECTIONS, bins))
    i, j = np.triu_indices(len(points), 1)
    x, y = (points[j] - points[i]).T
    direction = np.arctan2(y, x) / np.pi * DIRECTIONS
    distance = np.hypot(x, y) / PAIR_STEP - 0.5
    # Shares of neighbouring bins, so that little noise changes little.
    for a in (np.floor(direction), np.floor(direction) + 1):
        for b in (np.floor(distance), np.floor(distance) + 1):
            share = (1 - np.abs(direction - a)) * (1 - np.abs(distance - b))
            inside = (b >= 0) & (b < bins)
            at = a.astype(int)[inside] % DIRECTIONS, b.astype(int)[inside]
            np.add.at(histogram, at, share[inside])
    return histogram / max(histogram.sum(), 1e-9)


def histograms(features: Features) -> np.ndarray:
    """Histograms (K, directions, distances) of the landmarks of scans [K]."""
    wanted = np.asarray(features.valid) & (np.asarray(features.kind) != WALL)
    xy = np.asarray(features.xy, float)
    return np.stack([pair_histogram(points[keep]) for points, keep in zip(xy, wanted, strict=True)])


def similarities(histogram: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Overlap (K,) in 0 .. 1 of a histogram with others [K], at the best shift of directions."""
    shifts = [np.roll(histogram, shift, axis=0) for shift in range(DIRECTIONS)]
    return np.max([np.minimum(turned, others).sum(axis=(1, 2)) for turned in shifts], axis=0)
