import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import (
    alignment,
    association,
    closures,
    lidar,
    online,
    slam,
    smoother,
    sparse,
    topomap,
    world,
)
from jaxslam.alignment import AlignSpec
from jaxslam.closures import Closures
from jaxslam.geometry import unit
from jaxslam.lidar import Lidar
from jaxslam.poses import seen_from
from jaxslam.slam import Config, Inputs
from jaxslam.types import WALL
from jaxslam.world import World

T = 11
LIDAR = Lidar(beams=91, first=-np.pi / 2, step=np.pi / 90)
CONFIG = Config(lidar=LIDAR, landmarks=60, fresh=4, alignment=AlignSpec(scans=4, turns=(0.0,)))
NOISE = slam.log_noise(aligned=True)
START = jnp.array([2.5, 2.0, 0.3])


@pytest.fixture(scope="module", autouse=True)
def short():
    """Stretches of four scans, and a map that grows by 24 slots."""
    patch = pytest.MonkeyPatch()
    for name, value in {"STRETCH": 4, "ROOM": 24, "SPARE": 16}.items():
        patch.setattr(online, name, value)
    yield
    patch.undo()


@jax.jit
def look(walls, keys, poses):
    one = lambda key, pose: lidar.disturb(key, lidar.cast(walls, pose, LIDAR), LIDAR)
    return jax.vmap(one)(keys, poses)


@pytest.fixture(scope="module")
def drive():
    """Motions (T, 3) by wheels, and scans [T], of a way around the room."""
    turn = np.linspace(0.0, 2.0, T)
    poses = np.stack([2.5 + np.cos(turn), 2.0 + np.sin(turn), turn + np.pi / 2], axis=1)
    room, keys = world.named("fig07"), jax.random.split(jax.random.key(0), T)
    told = seen_from(poses[:-1], poses[1:]) + np.random.default_rng(0).normal(0, 0.01, (T - 1, 3))
    scans = _numpy(look(room, keys, jnp.asarray(poses)))
    return np.concatenate([np.zeros((1, 3)), told]), scans


def close(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), one, two)


@pytest.fixture(scope="module")
def surveys(drive):
    """By wheels and by scans: what was mapped, and what was known after each stretch."""

    def of(aligned):
        heard = []
        watch = lambda *now: heard.append(now)
        how = {"aligned": aligned, "watch": watch}
        return online.survey(CONFIG, NOISE, START, *drive, **how), heard

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(online, "ROOM", CONFIG.landmarks)
        wheels = of(False)
    return {False: wheels, True: of(True)}


@pytest.mark.parametrize("aligned", [False, True])
def test_stretches_give_what_one_log_with_all_room_gives(drive, surveys, aligned):
    """By scans, the map grows; by wheels, it has all room from the start."""
    motions, scans = drive
    seen, links = slam.local_maps(CONFIG, scans)
    told = None
    if aligned:
        local = alignment.empty(CONFIG.alignment, LIDAR)
        _, told = alignment.follow(CONFIG.alignment, LIDAR, local, scans, jnp.asarray(motions))
    inputs = Inputs(jnp.asarray(motions), seen, aligned=told)
    belief, info = slam.run(CONFIG, NOISE, slam.init(CONFIG, START), inputs)
    arcs = topomap.empty(arcs=2 * CONFIG.landmarks)
    add = jax.jit(topomap.add, static_argnames="lidar")
    given = _numpy((info.id, info.pose, links, scans))
    for t in range(T):
        arcs = add(arcs, *jax.tree.map(lambda x: x[t], given), lidar=LIDAR)  # noqa: B023
    found, heard = surveys[aligned]
    size = found.belief.seen.size
    assert size == (48 if aligned else CONFIG.landmarks) and np.sum(belief.seen > 0) > 6
    # A slot that is none is the number of slots.
    slot = np.where(found.info.slot == found.belief.seen.size, CONFIG.landmarks, found.info.slot)
    slot = np.where(np.asarray(info.slot) == CONFIG.landmarks, CONFIG.landmarks, slot)
    close(found.info._replace(slot=slot), info)
    close(found.nodes, seen)
    close(found.aligned, told)
    for few, all in zip(found.belief, belief, strict=True):
        np.testing.assert_allclose(few, np.asarray(all)[tuple(map(slice, few.shape))], atol=1e-9)
    mapper = heard[-1][0]
    close(mapper.arcs, jax.tree.map(lambda x: x[: 2 * size], arcs))
    assert not arcs.seen[2 * size :].any() and len(found.graph.id) > 4


def test_a_smoothed_drive_is_that_of_the_smoother(drive, surveys, monkeypatch):
    monkeypatch.setattr(online, "ROOM", CONFIG.landmarks)
    monkeypatch.setattr(online, "LIKE", 8)
    motions, scans = drive
    plain = surveys[False][0]
    found = online.survey(CONFIG, NOISE, START, motions, scans, smooth=True)
    close(found.info, plain.info)
    np.testing.assert_array_equal(plain.poses, plain.info.pose)
    marks = association.landmarks(plain.info.id, plain.info.pose, plain.nodes)
    inputs = Inputs(jnp.asarray(motions), jax.tree.map(jnp.asarray, plain.nodes))
    told = smoother.records(NOISE, START, inputs, marks.which, doubt=CONFIG.doubt)
    track = sparse.smooth(told, plain.info.pose, marks.places)
    assert np.abs(track.poses - plain.poses).max() > 1e-3  # there was something to do
    np.testing.assert_allclose(found.poses, track.poses, atol=1e-8)
    np.testing.assert_allclose(found.belief.pose, track.poses[-1], atol=1e-8)
    place = dict(zip(np.asarray(marks.id).tolist(), track.places, strict=True))
    moved = 0
    for slot in np.flatnonzero(found.belief.seen):
        own = plain.belief.places[slot]  # where it was not seen twice
        want = place.get(int(found.belief.id[slot]), own)
        np.testing.assert_allclose(found.belief.places[slot], want, atol=1e-8)
        moved += np.abs(want - own).max() > 1e-4
    assert moved > 4


@pytest.mark.parametrize("rounds", [1, 2])
def test_a_smoothed_drive_by_scans_is_tied_where_it_met_itself(drive, monkeypatch, rounds):
    monkeypatch.setattr(online, "LIKE", 8)
    if rounds == 2:
        monkeypatch.setattr(online, "STILL", 0.0)  # as if it had moved far
    motions, scans = drive
    plain = online.survey(CONFIG, NOISE, START, motions, scans, aligned=True, smooth=True)
    assert [len(x) for x in plain.closures] == [0] * 4  # it is too short to have
    apart = seen_from(plain.poses[1], plain.poses[9])
    tie = Closures(np.array([1]), np.array([9]), apart[None] + 0.01, 1e8 * np.eye(3)[None])
    heard = []

    def find(*given, scale):
        heard.append((*given, scale))
        return tie

    monkeypatch.setattr(closures, "find", find)
    found = online.survey(CONFIG, NOISE, START, motions, scans, aligned=True, smooth=True)
    np.testing.assert_allclose(seen_from(found.poses[1], found.poses[9]), apart + 0.01, atol=1e-4)
    assert found.closures is tie and len(heard) == rounds <= online.ROUNDS
    for poses, given in zip((plain.poses, found.poses), heard, strict=False):
        np.testing.assert_allclose(given[3], poses, atol=1e-3)
        assert given[:3] == (CONFIG.closures, CONFIG.alignment, LIDAR)
        assert given[5] == float(NOISE.alignment)
        jax.tree.map(np.testing.assert_array_equal, given[4], scans)


def test_a_stretch_is_told_when_it_is_done(surveys):
    found, heard = surveys[True]
    assert [len(part.info.finite) for _, part in heard] == [4, 4, 3]
    np.testing.assert_array_equal(heard[0][0].belief.pose, found.info.pose[3])
    np.testing.assert_array_equal(heard[1][1].info.id, found.info.id[4:8])
    close(heard[-1][0].belief, found.belief)


def test_scans_may_come_in_any_portions(drive, surveys):
    mapper, first = online.begin(CONFIG, START, aligned=True), 0
    for count in (1, 3, 2, 4, 1):
        some = jax.tree.map(lambda x: x[first : first + count], drive)  # noqa: B023
        mapper, part = online.extend(CONFIG, NOISE, mapper, *map(_numpy, some))
        assert len(part.info.pose) == count
        first += count
    found = surveys[True][0]
    # Room was made at other times: what counts lies in the same slots.
    count = min(mapper.belief.seen.size, found.belief.seen.size)
    np.testing.assert_allclose(mapper.belief.pose, found.belief.pose, atol=1e-9)
    np.testing.assert_array_equal(mapper.belief.seen[:count], found.belief.seen[:count])


def _numpy(tree):
    return jax.tree.map(np.asarray, tree)


def test_motions_by_scans_alone_are_those_of_the_whole_survey(drive, surveys):
    motions, scans = drive
    close(online.align(CONFIG, scans, motions), surveys[True][0].aligned)


def test_a_log_of_another_length_needs_no_other_program(drive, surveys, caplog):
    motions, scans = jax.tree.map(lambda x: x[:6], _numpy(drive))
    jax.config.update("jax_log_compiles", True)  # of all threads
    try:
        online.survey(CONFIG, NOISE, START, motions, scans, aligned=True)
        slam.local_maps(CONFIG, jax.tree.map(lambda x: jnp.asarray(x[:1]), scans))
    finally:
        jax.config.update("jax_log_compiles", False)
    assert caplog.text.count("Compiling jit(local_maps)") == 1  # of one scan
    assert "Compiling jit(_steps)" not in caplog.text


def test_a_room_of_six_walls_has_three_wall_directions(monkeypatch):
    monkeypatch.setattr(online, "ROOM", CONFIG.landmarks)
    corner = 4.0 * unit(jnp.arange(6.0) * jnp.pi / 3 + 0.2)
    walls = World(jnp.concatenate([corner, jnp.roll(corner, -1, axis=0)], axis=1))
    turn = np.linspace(0.0, 2 * np.pi, 32)
    poses = np.stack([np.cos(turn), np.sin(turn), turn + np.pi / 2], axis=1)
    keys = jax.random.split(jax.random.key(1), len(turn))
    scans = _numpy(look(walls, keys, jnp.asarray(poses)))
    motions = np.concatenate([np.zeros((1, 3)), seen_from(poses[:-1], poses[1:])])
    found = online.survey(CONFIG, slam.log_noise(), jnp.asarray(poses[0]), motions, scans).belief
    walls = np.asarray(slam.confirmed(CONFIG, found) & (found.kind == WALL))
    told = np.sort(np.degrees(np.asarray(found.places)[walls, 0]) % 180.0)
    # A wall is seen along its length, a third of the way round from the next.
    want = np.sort((np.degrees(0.2) + 120.0 + 60.0 * np.arange(3)) % 180.0)
    np.testing.assert_allclose(told, want, atol=1.0)


@pytest.mark.parametrize("count", [0, 5])
def test_a_stretch_has_its_number_of_scans(drive, count):
    some = jax.tree.map(lambda x: x[:count], _numpy(drive))
    with pytest.raises(ValueError, match=f"{count} scans; a stretch has 1 to 4"):
        online.extend(CONFIG, NOISE, online.begin(CONFIG, START, aligned=False), *some)
