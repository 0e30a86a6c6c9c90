"""Drives as in life: what a scan sees of people, doors and glass, and whole trials of it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import dead_reckoning, increments
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import concatenate_results
from jaxslam.simulation import (
    RangeErrors,
    Robot,
    Traffic,
    WheelFaults,
    World,
    densify,
    drives,
    life,
    life_in,
    named,
    run_trials,
    simulate_episodes,
    trial_episodes,
)

LIDAR = Lidar(num_beams=41, angle_min=-1.0, angle_increment=0.05, range_max=20.0, range_std=0.0)
# A thick wall at 4 m, one at 8 m behind it.
WALLS = np.array([[4.0, 9.0, 4.0, -9.0], [4.2, -9.0, 4.2, 9.0], [8.0, -20.0, 8.0, 20.0]])
WORLD = World(jnp.asarray(WALLS))
PATH = densify([(0.0, -3.0), (0.0, 3.0)])
POSE = jnp.zeros(3)
ANGLES = np.asarray(LIDAR.angle_min + LIDAR.angle_increment * np.arange(41))
DRIVE = densify([(1.0, 0.9), (3.5, 0.9), (3.5, 3.0)])


@jax.jit
def look(key, own, time):
    """A scan, and what happens on the drive."""
    events = life.draw_events(jax.random.fold_in(key, 1), own, 10)
    return life.scan_life(key, LIDAR, None, WORLD, own, events, POSE, time), events


def ranges_of(seed=0, **given):
    scan, _ = look(jax.random.key(seed), life_in(WORLD, PATH, **given), jnp.array(1.0))
    return np.where(scan.hit, scan.ranges, np.inf)


def test_without_anything_in_it_a_scan_is_that_of_the_walls():
    np.testing.assert_allclose(ranges_of(), 4.0 / np.cos(ANGLES), rtol=1e-9)


def test_the_two_faces_of_a_wall_are_one_piece():
    assert life.material_groups(WALLS).tolist() == [0, 0, 1]
    chain = np.concatenate([WALLS, [[4.4, -5.0, 4.4, 5.0], [4.0, 9.1, 4.0, 30.0]]])
    assert life.material_groups(chain).tolist() == [0, 0, 1, 0, 2]
    assert len(life.material_groups(np.zeros((0, 4)))) == 0


def test_a_beam_passes_through_glass_but_where_it_faces_it():
    """All is glass with a share of 1; then nothing but the beams ahead return."""
    glass = ranges_of(ranges=RangeErrors(glass=1.0, glass_angle=0.12))
    faces = np.abs(ANGLES) <= 0.12
    np.testing.assert_allclose(glass[faces], 4.0 / np.cos(ANGLES[faces]), rtol=1e-9)
    assert np.isinf(glass[~faces]).all()
    some = [ranges_of(seed, ranges=RangeErrors(glass=0.5)) for seed in range(30)]
    kinds = {tuple(np.round(x * np.cos(ANGLES)).tolist()) for x in some}
    through = np.where(np.abs(ANGLES) <= 0.1, 4.0, 8.0)
    assert kinds <= {
        tuple(k) for k in (np.full(41, 4.0), through, np.where(faces, 4.0, np.inf))
    } | {tuple(np.where(np.abs(ANGLES) <= 0.1, 4.0, np.inf).tolist())}
    assert tuple(through.tolist()) in kinds and tuple(np.full(41, 4.0).tolist()) in kinds


def test_black_walls_are_seen_from_near():
    black = ranges_of(ranges=RangeErrors(black=1.0, black_range=4.5))
    seen = 4.0 / np.cos(ANGLES) < 4.5 * np.cos(ANGLES)
    np.testing.assert_array_equal(np.isfinite(black), seen)
    assert seen.any() and not seen.all()


def test_people_are_seen_where_they_are():
    given = Traffic(people=8.0, standing=0.0)
    own = life_in(WORLD, densify([(2.0, -3.0), (2.0, 3.0)]), traffic=given)
    people_at = jax.jit(life.people_at)
    for time in (0.0, 7.0):
        scan, events = look(jax.random.key(0), own, jnp.array(time))
        centre, radius = people_at(events.crowd, given, own.movers, jnp.array(time), POSE[:2])
        steps = np.arange(0.01, 6.0, 0.001)[:, None, None]
        beam = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
        gap = np.linalg.norm(steps[..., None] * beam[:, None] - np.asarray(centre), axis=-1)
        inside = (gap < np.asarray(radius)).any(axis=2)
        first = np.where(inside.any(axis=0), steps[inside.argmax(axis=0), 0, 0], np.inf)
        wanted = np.minimum(first, 4.0 / np.cos(ANGLES))
        close = np.abs(np.asarray(scan.ranges) - wanted) < 0.003
        assert close.sum() >= 40 and np.isfinite(first).any()  # a beam may graze a person


def test_a_closed_door_is_seen_and_an_open_one_is_not():
    doors = [[3.0, -1.0, 3.0, 1.0]]
    closed = ranges_of(doors=doors, traffic=Traffic(closed=1.0))
    ahead = np.abs(np.tan(ANGLES)) < 1.0 / 3.0
    np.testing.assert_allclose(closed[ahead], 3.0 / np.cos(ANGLES[ahead]), rtol=1e-9)
    np.testing.assert_allclose(closed[~ahead], 4.0 / np.cos(ANGLES[~ahead]), rtol=1e-9)
    np.testing.assert_allclose(ranges_of(doors=doors), 4.0 / np.cos(ANGLES), rtol=1e-9)


@partial(jax.jit, static_argnames="num_scans")
def drive_of(key, own, num_scans=30):
    events = life.draw_events(key, own, num_scans)
    path = jnp.asarray(DRIVE)
    poses, odometry = drives.drive(
        key, Robot(encoder_noise=0.0), path, num_scans=num_scans, life=own, events=events
    )
    return poses, odometry, events


def test_slip_and_carrying_part_the_robot_from_its_odometry():
    key, world = jax.random.key(1), named("office")
    poses, odometry, _ = drive_of(key, life_in(world, DRIVE))
    np.testing.assert_allclose(odometry, increments(np.asarray(poses)), atol=1e-9)
    slips = life_in(world, DRIVE, wheels=WheelFaults(slip=0.3))
    poses, odometry, events = drive_of(key, slips)
    gap = np.linalg.norm(np.asarray(odometry) - increments(np.asarray(poses)), axis=1)[1:]
    moving = np.any(np.asarray(odometry)[1:] != 0.0, axis=1)
    slipping = np.asarray(events.faults.slip).any(axis=1)
    np.testing.assert_array_equal((gap > 1e-9), slipping & moving)
    carried = life_in(world, DRIVE, wheels=WheelFaults(carried=1.0, carry=1.0))
    poses, odometry, events = drive_of(key, carried)
    gap = np.linalg.norm(np.asarray(odometry) - increments(np.asarray(poses)), axis=1)[1:]
    assert np.flatnonzero(gap > 1e-9).tolist() == [int(events.faults.carried_at)]
    assert 0.7 < gap.max() < 1.5


@jax.jit
def lifeless(key):
    """True poses and odometry of five drives without life, 6 scans each."""

    def one(trial):
        own, _ = jax.random.split(jax.random.fold_in(key, trial))
        return drives.drive(own, Robot(), jnp.asarray(DRIVE), num_scans=6)

    return jax.vmap(one)(jnp.arange(5))


def test_a_trial_with_life_is_reproducible_and_has_the_drive_of_one_without():
    """On one device and in batches of four; without life fewer landmarks are missed."""
    config = Config.for_lidar(Lidar(num_beams=61, angle_min=-1.5, angle_increment=0.05))
    world, key, params = named("office"), jax.random.key(0), NoiseParams.for_simulated_robot()
    lively = life_in(
        world,
        DRIVE,
        traffic=Traffic(people=3.0),
        ranges=RangeErrors(missing=0.2, glass=0.1, spot=0.01),
        wheels=WheelFaults(dropped=0.3),
    )
    empty = life_in(world, DRIVE, max_people=len(lively.movers.people))

    def run(life, num_trials):
        given = {"num_trials": num_trials, "num_scans": 6, "devices": jax.devices()[:1]}
        parts = run_trials(key, config, params, Robot(), world, DRIVE, life=life, **given)
        return concatenate_results(list(parts))

    first, others = run(lively, 5), run(empty, 5)
    truth, odometry = jax.tree.map(np.asarray, lifeless(key))
    tracks = [dead_reckoning(*drive_) for drive_ in zip(truth[:, 0], odometry, strict=True)]
    np.testing.assert_allclose(first.truth, truth, atol=1e-12)
    np.testing.assert_allclose(first.dead_reckoning, tracks, atol=1e-12)
    assert np.sum(first.num_updates) < np.sum(others.num_updates)
    fewer = jax.tree.map(lambda x: x[:4], first)
    jax.tree.map(np.testing.assert_array_equal, run(lively, 4), fewer)


def test_episodes_are_simulated_with_the_life_that_is_given(monkeypatch):
    world, config = named("office"), Config.for_lidar(Lidar(num_beams=61))
    lively = life_in(world, DRIVE, traffic=Traffic(people=3.0))
    run = partial(simulate_episodes, jax.random.key(0), config, Robot(), world, DRIVE, num_trials=2)
    given = []
    monkeypatch.setattr(
        trial_episodes, "simulate_drives", lambda *_, life, **__: given.append(life)
    )
    run(num_scans=6, life=lively)
    assert given == [lively]
    other = lively._replace(materials=lively.materials[1:])
    with pytest.raises(ValueError, match="life.materials has 150 walls and world.walls 151; make"):
        run(num_scans=6, life=other)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"ranges": RangeErrors(missing=1.2)}, "ranges.missing is 1.2, not between 0 and 1"),
        ({"ranges": RangeErrors(spot=-1.0)}, "ranges.spot is -1.0, not 0 or more"),
        ({"traffic": Traffic(door_period=0.0)}, "traffic.door_period is 0.0, not above 0"),
        ({"traffic": Traffic(speed=np.inf)}, "traffic.speed is inf, not 0 or more"),
        ({"wheels": WheelFaults(lost_scans=0.5)}, "wheels.lost_scans is 0.5, not 1 or more"),
        ({"traffic": Traffic(people=3.0), "max_people": 2}, "max_people is 2, and traffic.people"),
        ({"doors": [[0.0, 1.0]]}, "doors is"),
    ],
)
def test_what_is_not_possible_is_named(given, message):
    with pytest.raises(ValueError, match=message):
        life_in(WORLD, PATH, **given)
