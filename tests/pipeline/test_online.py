import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import unit_vector
from jaxslam.core.se2_np import relative
from jaxslam.core.types import WALL
from jaxslam.filtering import config, slam_filter
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract
from jaxslam.mapping import arc_table
from jaxslam.matching import loop_closure, scan_matching
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.pipeline import offline, online
from jaxslam.pipeline.config import Config
from jaxslam.simulation import ray_casting, worlds
from jaxslam.simulation.worlds import World
from jaxslam.smoothing import numbering, problem, sparse

T = 11
LIDAR = Lidar(num_beams=91, angle_min=-np.pi / 2, angle_increment=np.pi / 90)
CONFIG = Config.for_lidar(
    LIDAR,
    filter=FilterConfig(
        max_landmarks=60,
        max_new=4,
    ),
    scan_matching=ScanMatchSpec(window_scans=4, heading_guesses=(0.0,)),
)
NOISE = NoiseParams.for_laser_log(match_scans=True)
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
    one = lambda key, pose: ray_casting.add_range_noise(
        key, LIDAR, ray_casting.cast(LIDAR, walls, pose)
    )
    return jax.vmap(one)(keys, poses)


@pytest.fixture(scope="module")
def drive():
    """Motions (T, 3) by wheels, and scans [T], of a way around the room."""
    turn = np.linspace(0.0, 2.0, T)
    poses = np.stack([2.5 + np.cos(turn), 2.0 + np.sin(turn), turn + np.pi / 2], axis=1)
    room, keys = worlds.named("fig07"), jax.random.split(jax.random.key(0), T)
    told = relative(poses[:-1], poses[1:]) + np.random.default_rng(0).normal(0, 0.01, (T - 1, 3))
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
        return offline.run_slam(CONFIG, NOISE, START, *drive, **how), heard

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(online, "SLOT_BLOCK", CONFIG.filter.max_landmarks)
        wheels = of(False)
    return {False: wheels, True: of(True)}


@pytest.mark.parametrize("aligned", [False, True])
def test_stretches_give_what_one_log_with_all_room_gives(drive, surveys, aligned):
    """By scans, the map grows; by wheels, it has all room from the start."""
    motions, scans = drive
    seen, links = extract.extract_local_graphs(CONFIG.frontend, scans)
    told = None
    if aligned:
        local = scan_matching.empty_submap(CONFIG.scan_matching, LIDAR)
        _, told = scan_matching.match_scans(
            CONFIG.scan_matching, LIDAR, local, scans, jnp.asarray(motions)
        )
    inputs = Measurement(jnp.asarray(motions), seen, scan_match=told)
    belief, info = slam_filter.run_filter(
        CONFIG.filter, NOISE, config.init(CONFIG.filter, START), inputs
    )
    arcs = arc_table.empty_arcs(capacity=2 * CONFIG.filter.max_landmarks)
    add = jax.jit(arc_table.add_scan_arcs, static_argnames="lidar")
    given = _numpy((info.id, info.pose, links, scans))
    for t in range(T):
        arcs = add(arcs, *jax.tree.map(lambda x: x[t], given), lidar=LIDAR)  # noqa: B023
    found, heard = surveys[aligned]
    size = found.belief.num_seen.size
    assert (
        size == (48 if aligned else CONFIG.filter.max_landmarks) and np.sum(belief.num_seen > 0) > 6
    )
    # A slot that is none is the number of slots.
    slot = np.where(
        found.info.slot == found.belief.num_seen.size, CONFIG.filter.max_landmarks, found.info.slot
    )
    slot = np.where(
        np.asarray(info.slot) == CONFIG.filter.max_landmarks, CONFIG.filter.max_landmarks, slot
    )
    close(found.info._replace(slot=slot), info)
    close(found.nodes, seen)
    close(found.aligned, told)
    for few, all in zip(found.belief, belief, strict=True):
        np.testing.assert_allclose(few, np.asarray(all)[tuple(map(slice, few.shape))], atol=1e-9)
    mapper = heard[-1][0]
    close(mapper.arcs, jax.tree.map(lambda x: x[: 2 * size], arcs))
    assert not arcs.num_seen[2 * size :].any() and len(found.graph.id) > 4


def test_a_smoothed_drive_is_that_of_the_smoother(drive, surveys, monkeypatch):
    monkeypatch.setattr(online, "SLOT_BLOCK", CONFIG.filter.max_landmarks)
    monkeypatch.setattr(offline, "PADDING_MULTIPLE", 8)
    motions, scans = drive
    plain = surveys[False][0]
    found = offline.run_slam(CONFIG, NOISE, START, motions, scans, smooth=True)
    close(found.info, plain.info)
    np.testing.assert_array_equal(plain.poses, plain.info.pose)
    marks = numbering.number_landmarks(plain.info.id, plain.info.pose, plain.features)
    inputs = Measurement(jnp.asarray(motions), jax.tree.map(jnp.asarray, plain.features))
    told = problem.build_problem(
        NOISE,
        START,
        inputs,
        marks.landmark_index,
        untrusted_inflation=CONFIG.filter.untrusted_inflation,
    )
    track = sparse.smooth_log(told, plain.info.pose, marks.positions)
    assert np.abs(track.poses - plain.poses).max() > 1e-3  # there was something to do
    np.testing.assert_allclose(found.poses, track.poses, atol=1e-8)
    np.testing.assert_allclose(found.belief.pose, track.poses[-1], atol=1e-8)
    place = dict(zip(np.asarray(marks.id).tolist(), track.landmark_positions, strict=True))
    moved = 0
    for slot in np.flatnonzero(found.belief.num_seen):
        own = plain.belief.landmark_positions[slot]  # where it was not seen twice
        want = place.get(int(found.belief.id[slot]), own)
        np.testing.assert_allclose(found.belief.landmark_positions[slot], want, atol=1e-8)
        moved += np.abs(want - own).max() > 1e-4
    assert moved > 4


@pytest.mark.parametrize("rounds", [1, 2])
def test_a_smoothed_drive_by_scans_is_tied_where_it_met_itself(drive, monkeypatch, rounds):
    monkeypatch.setattr(offline, "PADDING_MULTIPLE", 8)
    if rounds == 2:
        monkeypatch.setattr(offline, "CLOSURE_CONVERGED", 0.0)  # as if it had moved far
    motions, scans = drive
    plain = offline.run_slam(CONFIG, NOISE, START, motions, scans, match_scans=True, smooth=True)
    assert [len(x) for x in plain.loop_closures] == [0] * 4  # it is too short to have
    apart = relative(plain.poses[1], plain.poses[9])
    tie = LoopClosures(np.array([1]), np.array([9]), apart[None] + 0.01, 1e8 * np.eye(3)[None])
    heard = []

    def find(*given, scale):
        heard.append((*given, scale))
        return tie

    monkeypatch.setattr(loop_closure, "find_loop_closures", find)
    found = offline.run_slam(CONFIG, NOISE, START, motions, scans, match_scans=True, smooth=True)
    np.testing.assert_allclose(relative(found.poses[1], found.poses[9]), apart + 0.01, atol=1e-4)
    assert found.loop_closures is tie and len(heard) == rounds <= offline.MAX_CLOSURE_ROUNDS
    for poses, given in zip((plain.poses, found.poses), heard, strict=False):
        np.testing.assert_allclose(given[3], poses, atol=1e-3)
        assert given[:3] == (CONFIG.loop_closure, CONFIG.scan_matching, LIDAR)
        assert given[5] == float(NOISE.scan_match_std_scale)
        jax.tree.map(np.testing.assert_array_equal, given[4], scans)


def test_a_stretch_is_told_when_it_is_done(surveys):
    found, heard = surveys[True]
    assert [len(part.info.finite) for _, part in heard] == [4, 4, 3]
    np.testing.assert_array_equal(heard[0][0].belief.pose, found.info.pose[3])
    np.testing.assert_array_equal(heard[1][1].info.id, found.info.id[4:8])
    close(heard[-1][0].belief, found.belief)


def test_scans_may_come_in_any_portions(drive, surveys):
    mapper, first = online.init(CONFIG, START, match_scans=True), 0
    for count in (1, 3, 2, 4, 1):
        some = jax.tree.map(lambda x: x[first : first + count], drive)  # noqa: B023
        mapper, part = online.update(CONFIG, NOISE, mapper, *map(_numpy, some))
        assert len(part.info.pose) == count
        first += count
    found = surveys[True][0]
    # Room was made at other times: what counts lies in the same slots.
    count = min(mapper.belief.num_seen.size, found.belief.num_seen.size)
    np.testing.assert_allclose(mapper.belief.pose, found.belief.pose, atol=1e-9)
    np.testing.assert_array_equal(mapper.belief.num_seen[:count], found.belief.num_seen[:count])


def _numpy(tree):
    return jax.tree.map(np.asarray, tree)


def test_motions_by_scans_alone_are_those_of_the_whole_survey(drive, surveys):
    motions, scans = drive
    close(online.match_log(CONFIG, scans, motions), surveys[True][0].scan_matches)


def test_a_log_of_another_length_needs_no_other_program(drive, surveys, caplog):
    motions, scans = jax.tree.map(lambda x: x[:6], _numpy(drive))
    jax.config.update("jax_log_compiles", True)  # of all threads
    try:
        offline.run_slam(CONFIG, NOISE, START, motions, scans, match_scans=True)
        extract.extract_local_graphs(
            CONFIG.frontend, jax.tree.map(lambda x: jnp.asarray(x[:1]), scans)
        )
    finally:
        jax.config.update("jax_log_compiles", False)
    assert caplog.text.count("Compiling jit(local_maps)") == 1  # of one scan
    assert "Compiling jit(_steps)" not in caplog.text


def test_a_room_of_six_walls_has_three_wall_directions(monkeypatch):
    monkeypatch.setattr(online, "SLOT_BLOCK", CONFIG.filter.max_landmarks)
    corner = 4.0 * unit_vector(jnp.arange(6.0) * jnp.pi / 3 + 0.2)
    walls = World(jnp.concatenate([corner, jnp.roll(corner, -1, axis=0)], axis=1))
    turn = np.linspace(0.0, 2 * np.pi, 32)
    poses = np.stack([np.cos(turn), np.sin(turn), turn + np.pi / 2], axis=1)
    keys = jax.random.split(jax.random.key(1), len(turn))
    scans = _numpy(look(walls, keys, jnp.asarray(poses)))
    motions = np.concatenate([np.zeros((1, 3)), relative(poses[:-1], poses[1:])])
    found = offline.run_slam(
        CONFIG, NoiseParams.for_laser_log(), jnp.asarray(poses[0]), motions, scans
    ).belief
    walls = np.asarray(config.confirmed(CONFIG.filter, found) & (found.kind == WALL))
    told = np.sort(np.degrees(np.asarray(found.landmark_positions)[walls, 0]) % 180.0)
    # A wall is seen along its length, a third of the way round from the next.
    want = np.sort((np.degrees(0.2) + 120.0 + 60.0 * np.arange(3)) % 180.0)
    np.testing.assert_allclose(told, want, atol=1.0)


@pytest.mark.parametrize("count", [0, 5])
def test_a_stretch_has_its_number_of_scans(drive, count):
    some = jax.tree.map(lambda x: x[:count], _numpy(drive))
    with pytest.raises(ValueError, match=f"{count} scans; a stretch has 1 to 4"):
        online.update(CONFIG, NOISE, online.init(CONFIG, START, match_scans=False), *some)
