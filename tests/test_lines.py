import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import edges, lidar, lines, world
from jaxslam.edges import RunSpec
from jaxslam.lidar import Lidar
from jaxslam.lines import NONE, Spans

SPEC = RunSpec()
runs = jax.jit(edges.runs, static_argnums=(1, 2))
split = jax.jit(lines.split, static_argnames=("tolerance", "rounds"))
merge = jax.jit(lines.merge, static_argnames=("tolerance", "rounds"))


def spans_of(*pairs, capacity=12):
    pad = capacity - len(pairs)
    first, last = [a for a, _ in pairs] + [NONE] * pad, [b for _, b in pairs] + [-1] * pad
    return Spans(jnp.array(first, jnp.int32), jnp.array(last, jnp.int32))


def pairs_of(spans):
    return [
        (a, b) for a, b in zip(spans.first.tolist(), spans.last.tolist(), strict=True) if b >= 0
    ]


def slow_split(first, last, xy, tolerance):
    """Split one stretch at the point furthest from its chord, until none is too far."""
    chord = xy[last] - xy[first]
    d = xy[first : last + 1] - xy[first]
    off = np.abs(d[:, 1] * chord[0] - d[:, 0] * chord[1]) / np.hypot(*chord)
    if off.max() <= tolerance:
        return [(first, last)]
    at = first + int(np.argmax(off))
    return slow_split(first, at - 1, xy, tolerance) + slow_split(at, last, xy, tolerance)


@pytest.mark.parametrize("seed", range(6))
def test_split_agrees_with_recursion(seed):
    random = np.random.default_rng(seed)
    turns = np.repeat(random.uniform(-1, 1, 5), 8)
    xy = np.cumsum(0.1 * np.stack([np.cos(turns), np.sin(turns)], axis=1), axis=0)
    ours = split(spans_of((0, 39)), jnp.asarray(xy), tolerance=0.06, rounds=8)
    wanted = slow_split(0, 39, xy, 0.06)
    assert pairs_of(ours) == wanted and len(wanted) > 1


@pytest.mark.parametrize("step", [0.5, 1.0])
@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_a_straight_noisy_wall_is_one_run(noise, step):
    beams = int(100 / step) + 1
    scanner = Lidar(beams=beams, first=-math.radians(50), step=math.radians(step), noise=noise)
    walls = world.World(jnp.array([[2.0, -9.0, 2.0, 9.0]]))
    clean = lidar.cast(walls, jnp.zeros(3), scanner)
    keys = jax.random.split(jax.random.key(0), 200)
    one = lambda key: edges.runs(lidar.disturb(key, clean, scanner), scanner, SPEC).valid.sum()
    count = np.asarray(jax.jit(jax.vmap(one))(keys))
    assert np.mean(count == 1) >= 0.98, np.bincount(count)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_corner_is_put_at_its_beam(noise):
    scanner = Lidar(beams=181, first=-math.pi / 4, step=math.pi / 360, noise=0.01)
    walls = world.World(jnp.asarray(world.polyline([(3.0, -9.0), (3.0, 1.0), (-2.0, 1.0)])))
    scan = lidar.cast(walls, jnp.zeros(3), scanner)
    if noise:
        scan = lidar.disturb(jax.random.key(1), scan, scanner)
    of = np.asarray(runs(scan, scanner, SPEC).of_beam)
    beam = (math.atan2(1.0, 3.0) - scanner.first) / scanner.step  # 126.9
    np.testing.assert_allclose(np.flatnonzero(np.diff(of)) + 0.5, beam, atol=1.5 if noise else 0.5)
    assert of[0] == 0 and of[-1] == 1


@pytest.mark.parametrize("bend, wanted", [(0.0, [(0, 19)]), (0.3, [(0, 9), (10, 19)])])
def test_merge_joins_what_lies_on_one_line(bend, wanted):
    x = 0.1 * np.arange(20.0)
    xy = jnp.asarray(np.stack([x, bend * np.maximum(x - 0.95, 0)], axis=1))
    parts = spans_of((0, 4), (5, 9), (10, 14), (15, 19))
    ours = merge(parts, xy, jnp.zeros(20, bool), tolerance=0.02, rounds=4)
    assert pairs_of(ours) == wanted
    apart = jnp.arange(20) == 5
    assert (0, 4) in pairs_of(merge(parts, xy, apart, tolerance=0.02, rounds=4))


def test_those_with_fewest_beams_are_left_out():
    spans = spans_of((0, 4), (5, 6), (7, 9), (10, 10), (11, 20))
    kept = lines.longest(spans, capacity=3)
    assert pairs_of(kept) == [(0, 4), (7, 9), (11, 20)]
    np.testing.assert_array_equal(kept.of_beam(12), [0] * 5 + [3] * 2 + [1] * 3 + [3] + [2])
    padded = lines.longest(spans_of((0, 4)), capacity=3)
    assert padded.first.tolist() == [0, NONE, NONE] and padded.last.tolist() == [4, -1, -1]


def test_moments_of_two_sets_add_up():
    xy = jnp.asarray(np.random.default_rng(0).normal(size=(30, 2)))
    weight = jnp.linspace(0.5, 2.0, 30)
    of = jnp.asarray(np.arange(30) % 2, jnp.int32)
    take = lambda sums, k: jax.tree.map(lambda x: x[k : k + 1], sums)
    parts = lines.moments(xy, weight, of, lines=2)
    whole = lines.moments(xy, weight, jnp.zeros(30, jnp.int32), lines=1)
    both = lines.joined(take(parts, 0), take(parts, 1))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), both, whole)
