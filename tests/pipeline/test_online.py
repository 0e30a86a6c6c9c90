import re
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import polylines, se2_np
from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import unit_vector
from jaxslam.core.se2_np import increments, relative
from jaxslam.core.types import CORNER, WALL
from jaxslam.filtering import config as filter_config
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract
from jaxslam.mapping import arc_table
from jaxslam.mapping.config import MappingSpec
from jaxslam.matching import loop_closure, scan_matching
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.matching.registration import LoopClosureSpec
from jaxslam.pipeline import chunks, offline, online, smoothing_stage
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.online import SlamState
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
    scan_matching=ScanMatchSpec(window_scans=4),
)
PARAMS = NoiseParams.for_laser_log(match_scans=True)
START = jnp.array([2.5, 2.0, 0.3])


@pytest.fixture(scope="module", autouse=True)
def short():
    """Chunks of four scans, and a map that grows by 24 slots."""
    patch = pytest.MonkeyPatch()
    for name, value in {"CHUNK": 4, "SLOT_BLOCK": 24, "MIN_FREE_SLOTS": 16}.items():
        patch.setattr(chunks, name, value)
    yield
    patch.undo()


@jax.jit
def scans_of(world, keys, poses):
    def scan(key, pose):
        return ray_casting.add_range_noise(key, LIDAR, ray_casting.cast(LIDAR, world, pose))

    return jax.vmap(scan)(keys, poses)


@pytest.fixture(scope="module")
def drive():
    """Odometry (T, 3) and scans [T] of a path around the room."""
    turn = np.linspace(0.0, 2.0, T)
    poses = np.stack([2.5 + np.cos(turn), 2.0 + np.sin(turn), turn + np.pi / 2], axis=1)
    room, keys = worlds.named("fig07"), jax.random.split(jax.random.key(0), T)
    odometry = increments(poses)
    odometry[1:] += np.random.default_rng(0).normal(0, 0.01, (T - 1, 3))
    return odometry, as_numpy(scans_of(room, keys, jnp.asarray(poses)))


def assert_close(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), one, two)


def extracted(scans):
    """Features and local arcs [T], of as many scans at a time as in a chunk."""
    parts = []
    for first in range(0, T, 4):
        now = np.minimum(np.arange(first, first + 4), T - 1)
        some = jax.tree.map(lambda x: jnp.asarray(x[now]), scans)  # noqa: B023
        parts.append(as_numpy(extract.extract_local_graphs(CONFIG.frontend, some)))
    return jax.tree.map(lambda *x: np.concatenate(x)[:T], *parts)


def online_slam(drive, **options):
    """The result of SLAM without smoothing."""
    return offline.run_slam(CONFIG, PARAMS, *drive, start=START, **{"smooth": False} | options)


@pytest.fixture(scope="module")
def results(drive):
    """Without and with scan matching: the result, and state and result after each chunk."""

    def run(match_scans):
        after = []

        def callback(*state_and_part):
            after.append(state_and_part)

        return online_slam(drive, match_scans=match_scans, callback=callback), after

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "SLOT_BLOCK", CONFIG.filter.max_landmarks)
        by_odometry = run(False)
    return {False: by_odometry, True: run(True)}


@pytest.mark.parametrize("match_scans", [False, True])
def test_chunks_give_the_result_of_one_filter_with_full_capacity(drive, results, match_scans):
    """With scan matching the map grows; without, it has its full capacity from the start."""
    odometry, scans = drive
    features, local_arcs = extracted(scans)
    matches = None
    if match_scans:
        submap = scan_matching.empty_submap(CONFIG.scan_matching, LIDAR)
        _, matches = scan_matching.match_scans(
            CONFIG.scan_matching, LIDAR, submap, scans, jnp.asarray(odometry)
        )
    measurements = Measurement(
        jnp.asarray(odometry), jax.tree.map(jnp.asarray, features), scan_match=matches
    )
    belief, info = slam_filter.run_filter(
        CONFIG.filter, PARAMS, filter_config.init(CONFIG.filter, START), measurements
    )
    arcs = arc_table.empty_arcs(capacity=2 * CONFIG.filter.max_landmarks)
    add = jax.jit(arc_table.add_scan_arcs, static_argnames="lidar")
    given = as_numpy((info.id, info.pose, local_arcs, scans))
    for t in range(T):
        ids, pose, arcs_of_scan, scan = jax.tree.map(lambda x: x[t], given)  # noqa: B023
        arcs = add(LIDAR, arcs, ids, pose, arcs_of_scan, scan)
    found, after = results[match_scans]
    size, capacity = found.belief.num_seen.size, CONFIG.filter.max_landmarks
    assert size == (48 if match_scans else capacity) and np.sum(belief.num_seen > 0) > 6
    # A slot that is none is the number of slots.
    slot = np.where(found.info.slot == size, capacity, found.info.slot)
    slot = np.where(np.asarray(info.slot) == capacity, capacity, slot)
    assert_close(found.info._replace(slot=slot), info)
    assert_close(found.features, features)
    assert_close(found.scan_matches, matches)
    for few, many in zip(*map(jax.tree.leaves, (found.belief, belief)), strict=True):
        np.testing.assert_allclose(few, np.asarray(many)[tuple(map(slice, few.shape))], atol=1e-9)
    state = after[-1][0]
    assert_close(state.arcs, jax.tree.map(lambda x: x[: 2 * size], arcs))
    assert not arcs.num_seen[2 * size :].any() and len(found.topological_map.id) > 4


def test_a_smoothed_drive_is_that_of_the_smoother(drive, results, monkeypatch):
    monkeypatch.setattr(chunks, "SLOT_BLOCK", CONFIG.filter.max_landmarks)
    monkeypatch.setattr(smoothing_stage, "PADDING_MULTIPLE", 8)
    plain = results[False][0]
    found = online_slam(drive, match_scans=False, smooth=True)
    assert_close(found.info, plain.info)
    np.testing.assert_array_equal(plain.poses, plain.info.pose)
    numbered = numbering.number_landmarks(plain.info.id, plain.info.pose, plain.features)
    measurements = Measurement(jnp.asarray(drive[0]), jax.tree.map(jnp.asarray, plain.features))
    posed = problem.build_problem(
        PARAMS,
        START,
        measurements,
        numbered.landmark_index,
        untrusted_inflation=CONFIG.filter.untrusted_inflation,
    )
    smoothed = sparse.smooth_log(posed, plain.info.pose, numbered.positions)
    assert np.abs(smoothed.poses - plain.poses).max() > 1e-3  # there was something to do
    np.testing.assert_allclose(found.poses, smoothed.poses, atol=1e-8)
    np.testing.assert_allclose(found.belief.pose, smoothed.poses[-1], atol=1e-8)
    ids = np.asarray(numbered.id).tolist()
    position = dict(zip(ids, smoothed.landmark_positions, strict=True))
    moved = 0
    for slot in np.flatnonzero(found.belief.num_seen):
        own = plain.belief.landmark_positions[slot]  # where it was not seen twice
        want = position.get(int(found.belief.id[slot]), own)
        np.testing.assert_allclose(found.belief.landmark_positions[slot], want, atol=1e-8)
        moved += np.abs(want - own).max() > 1e-4
    assert moved > 4


@pytest.mark.parametrize("rounds", [1, 2])
def test_loop_closures_are_searched_and_smoothed_with(drive, monkeypatch, rounds):
    monkeypatch.setattr(smoothing_stage, "PADDING_MULTIPLE", 8)
    if rounds == 2:
        monkeypatch.setattr(smoothing_stage, "CLOSURE_CONVERGED", 0.0)  # as if it had moved far
    plain = online_slam(drive, smooth=True)
    assert [len(x) for x in plain.loop_closures] == [0] * 4  # it is too short to have any
    apart = relative(plain.poses[1], plain.poses[9])
    closure = LoopClosures(np.array([1]), np.array([9]), apart[None] + 0.01, 1e8 * np.eye(3)[None])
    calls = []

    def find(*args, std_scale):
        calls.append((*args, std_scale))
        return closure

    monkeypatch.setattr(loop_closure, "find_loop_closures", find)
    found = online_slam(drive, smooth=True)
    np.testing.assert_allclose(relative(found.poses[1], found.poses[9]), apart + 0.01, atol=1e-4)
    assert (
        found.loop_closures is closure
        and len(calls) == rounds <= smoothing_stage.MAX_CLOSURE_ROUNDS
    )
    for poses, args in zip((plain.poses, found.poses), calls, strict=False):
        np.testing.assert_allclose(args[3], poses, atol=1e-3)
        assert args[:3] == (CONFIG.loop_closure, CONFIG.scan_matching, LIDAR)
        assert args[5] == float(PARAMS.scan_match_std_scale)
        jax.tree.map(np.testing.assert_array_equal, args[4], drive[1])


def test_the_callback_is_called_after_each_chunk(results):
    found, after = results[True]
    assert [len(part.info.finite) for _, part in after] == [4, 4, 3]
    np.testing.assert_array_equal(after[0][0].belief.pose, found.info.pose[3])
    np.testing.assert_array_equal(after[1][1].info.id, found.info.id[4:8])
    assert_close(after[-1][0].belief, found.belief)


def test_the_map_at_the_end_is_of_all_scans(drive, results):
    found = results[True][0]
    graph, grid = found.topological_map, found.occupancy
    assert len(graph.arc_ends) and found.next_id >= int(found.belief.next_id)
    ends = np.concatenate([graph.arc_ends.ravel(), np.flatnonzero(graph.kind == CORNER)])
    assert set(ends.tolist()) == set(range(len(graph.id)))  # every node is joined
    for line in graph.arc_lines:
        points = polylines.resample(line, 200)
        # This robot drives through the end of a wall.
        points = points[polylines.project(points, found.poses[:, :2])[0] > 0.2]
        cell = np.floor((points - grid.origin[:2]) / grid.resolution)
        assert not grid.occupied[tuple(cell.astype(int).T)].any()
    landmarks = np.asarray(found.belief.id)[np.asarray(found.belief.num_seen) > 0]
    fresh = graph.id[~np.isin(graph.id, landmarks)]
    assert (fresh >= int(found.belief.next_id)).all() and (fresh < found.next_id).all()


def test_the_merged_map_is_that_of_the_state(drive, results):
    merged = CONFIG._replace(mapping=MappingSpec("merged"))
    found = offline.run_slam(merged, PARAMS, *drive, start=START, smooth=False)
    state = SlamState(found.belief, found.arcs, None)
    expected = online.topological_map(merged, state, found.poses)
    for ours, wanted in zip(found.topological_map, expected, strict=True):
        for one, other in zip(ours, wanted, strict=True):
            np.testing.assert_array_equal(one, other)
    assert found.next_id == int(found.belief.next_id)
    np.testing.assert_array_equal(found.occupancy.free.shape, results[True][0].occupancy.free.shape)


@pytest.mark.parametrize(
    "spec, problem",
    [
        (MappingSpec("whole"), "mapping.topology is 'whole', not 'grid' or 'merged'"),
        (MappingSpec(robot_radius=-1.0), "mapping.robot_radius is -1.0, not a positive"),
        (3, "mapping is a int, not a MappingSpec"),
    ],
)
def test_a_map_that_cannot_be_made_is_refused(drive, spec, problem):
    with pytest.raises(ValueError, match=problem):
        offline.run_slam(CONFIG._replace(mapping=spec), PARAMS, *drive)


def test_scans_may_come_in_any_portions(drive, results):
    state, first = online.init(CONFIG, START), 0
    for count in (1, 3, 2, 4, 1):
        some = jax.tree.map(lambda x: x[first : first + count], drive)  # noqa: B023
        state, part = online.update(CONFIG, PARAMS, state, *some)
        assert len(part.info.pose) == count
        first += count
    found = results[True][0]
    # The map grew at other times: what counts is in the same slots.
    count = min(state.belief.num_seen.size, found.belief.num_seen.size)
    np.testing.assert_allclose(state.belief.pose, found.belief.pose, atol=1e-9)
    np.testing.assert_array_equal(state.belief.num_seen[:count], found.belief.num_seen[:count])


def as_numpy(tree):
    return jax.tree.map(np.asarray, tree)


def test_increments_by_scan_matching_alone_are_those_of_slam(drive, results):
    assert_close(online.match_log(CONFIG, *drive), results[True][0].scan_matches)


KEYFRAME_DISTANCE = (0.5, 0.5)  # the drive's steps are of 0.2 m and 0.2 rad: every third scan


@pytest.fixture(scope="module")
def with_keyframes(drive):
    """Result of SLAM on keyframes, not smoothed, and what the callback was given."""
    config, after = CONFIG._replace(keyframe_distance=KEYFRAME_DISTANCE), []

    def callback(*state_and_part):
        after.append(state_and_part)

    found = offline.run_slam(config, PARAMS, *drive, start=START, smooth=False, callback=callback)
    return found, after


def test_the_filter_is_given_keyframes_alone(drive, results, with_keyframes):
    (found, after), every = with_keyframes, results[True][0]
    assert found.keyframes.tolist() == [0, 3, 6, 9, 10]
    assert_close(found.features, jax.tree.map(lambda x: x[found.keyframes], every.features))
    wheels = se2_np.dead_reckoning(np.zeros(3), drive[0])
    by_scans = se2_np.dead_reckoning(np.zeros(3), every.scan_matches.increment)
    for poses, given in ((wheels, found.odometry), (by_scans, found.scan_matches.increment)):
        np.testing.assert_allclose(given, increments(poses[found.keyframes]), atol=1e-9)
    measurements = Measurement(found.odometry, found.features, scan_match=found.scan_matches)
    count = len(found.keyframes)
    # As long as the drive, for a program that there is: what comes later changes nothing before.
    longer = jax.tree.map(
        lambda x: jnp.asarray(np.concatenate([x, np.repeat(x[-1:], T - count, axis=0)])),
        measurements,
    )
    _, info = slam_filter.run_filter(
        CONFIG.filter, PARAMS, filter_config.init(CONFIG.filter, START), longer
    )
    np.testing.assert_allclose(found.info.pose, info.pose[:count], atol=1e-9)
    assert [part.keyframes.tolist() for _, part in after] == [[0, 3, 6, 9], [10]]
    np.testing.assert_array_equal(after[0][0].belief.pose, found.info.pose[3])


def test_scans_between_keyframes_have_poses_by_their_own_motion(drive, with_keyframes):
    found, _ = with_keyframes
    np.testing.assert_array_equal(found.online_poses[found.keyframes], found.info.pose)
    np.testing.assert_array_equal(found.poses, found.online_poses)
    matched = online.match_log(CONFIG, *drive).increment
    for t in np.setdiff1d(np.arange(T), found.keyframes):
        want = se2_np.compose(found.poses[t - 1], matched[t])
        np.testing.assert_allclose(found.poses[t], want, atol=1e-9)


def test_a_smoothed_drive_on_keyframes_is_as_good_as_on_every_scan(drive, monkeypatch):
    """One scan of this drive is matched 0.14 m off; keyframes are not drawn after it."""
    monkeypatch.setattr(smoothing_stage, "PADDING_MULTIPLE", 8)
    turn = np.linspace(0.0, 2.0, T)
    true = np.stack([np.cos(turn), np.sin(turn), turn + np.pi / 2], axis=1)
    errors = []
    for distance in (None, KEYFRAME_DISTANCE):
        config = CONFIG._replace(keyframe_distance=distance)
        found = offline.run_slam(config, PARAMS, *drive, start=START)
        error = relative(relative(true[0], true), relative(found.poses[0], found.poses))
        errors.append(np.hypot(error[:, 0], error[:, 1]))
    assert errors[1].max() < errors[0].max() < 0.2
    assert errors[1][found.keyframes].max() < 0.03


def test_without_scan_matching_every_scan_is_a_keyframe(drive, results, monkeypatch):
    monkeypatch.setattr(chunks, "SLOT_BLOCK", CONFIG.filter.max_landmarks)
    config = CONFIG._replace(keyframe_distance=KEYFRAME_DISTANCE)
    plain = offline.run_slam(config, PARAMS, *drive, start=START, match_scans=False, smooth=False)
    np.testing.assert_array_equal(plain.keyframes, np.arange(T))
    np.testing.assert_allclose(plain.poses, results[False][0].poses, atol=1e-9)


def test_nothing_is_matched_any_more_after_a_run_that_fails(drive, monkeypatch):
    matched = []

    def match(config, submap, odometry, scans, guessed):
        matched.append(len(odometry))
        time.sleep(0.05)
        return submap, scan_matches

    def fail(*_):
        raise KeyboardInterrupt

    scan_matches = online.match_log(CONFIG, *jax.tree.map(lambda x: x[:4], drive))
    monkeypatch.setattr(chunks, "match_chunk", match)
    long = jax.tree.map(lambda x: np.concatenate([x[:4]] * 50), drive)
    long[0][0] = 0.0
    with pytest.raises(KeyboardInterrupt):
        online_slam(long, callback=fail)
    count = len(matched)
    time.sleep(0.2)
    assert len(matched) == count < 50


def compiled(caplog, run):
    """Names of the programs that a function compiles, in all threads."""
    caplog.clear()
    jax.config.update("jax_log_compiles", True)
    try:
        run()
    finally:
        jax.config.update("jax_log_compiles", False)
    return re.findall(r"Compiling jit\((\w+)\)", caplog.text)


def test_a_log_of_another_length_needs_no_other_program(drive, results, caplog):
    odometry, scans = jax.tree.map(lambda x: x[:6], drive)
    names = compiled(caplog, lambda: online_slam((odometry, scans)))
    assert not {"extract_local_graphs", "_match_scans", "_steps", "_init"} & set(names)
    config = CONFIG._replace(keyframe_distance=KEYFRAME_DISTANCE)
    names = compiled(caplog, lambda: offline.run_slam(config, PARAMS, *drive, smooth=False))
    assert not {"extract_local_graphs", "_match_scans", "_steps", "_init"} & set(names)

    def small_program(x):
        return x + 1.0

    # What is compiled is heard of.
    assert "small_program" in compiled(caplog, lambda: jax.jit(small_program)(jnp.zeros(7)))


def test_another_loop_closure_compiles_no_other_stage(drive, caplog, monkeypatch):
    monkeypatch.setattr(smoothing_stage, "PADDING_MULTIPLE", 8)

    def run(spec):
        config = CONFIG._replace(loop_closure=spec)
        return offline.run_slam(config, PARAMS, *drive, start=START)

    close = LoopClosureSpec(query_spacing=0.2, min_path_between=1.0)
    assert not len(run(LoopClosureSpec()).loop_closures.first)
    names = compiled(caplog, lambda: run(close))
    assert "register_batch" in names
    stages = {"extract_local_graphs", "match_scans", "_init", "_steps", "build_problem"}
    assert not (stages | {"whitened", "_evaluate", "wrap_state"}) & set(names)


def test_a_room_of_six_walls_has_three_wall_directions(monkeypatch):
    monkeypatch.setattr(chunks, "SLOT_BLOCK", CONFIG.filter.max_landmarks)
    corner = 4.0 * unit_vector(jnp.arange(6.0) * jnp.pi / 3 + 0.2)
    world = World(jnp.concatenate([corner, jnp.roll(corner, -1, axis=0)], axis=1))
    turn = np.linspace(0.0, 2 * np.pi, 32)
    poses = np.stack([np.cos(turn), np.sin(turn), turn + np.pi / 2], axis=1)
    keys = jax.random.split(jax.random.key(1), len(turn))
    scans = scans_of(world, keys, jnp.asarray(poses))
    found = offline.run_slam(
        CONFIG,
        PARAMS,
        increments(poses),
        scans,
        start=poses[0],
        match_scans=False,
        smooth=False,
    ).belief
    walls = np.asarray(filter_config.confirmed(CONFIG.filter, found) & (found.kind == WALL))
    mapped = np.sort(np.degrees(np.asarray(found.landmark_positions)[walls, 0]) % 180.0)
    # A wall is seen along its length, a third of the circle from the next.
    want = np.sort((np.degrees(0.2) + 120.0 + 60.0 * np.arange(3)) % 180.0)
    np.testing.assert_allclose(mapped, want, atol=1.0)


@pytest.mark.parametrize("count, line", [(0, "odometry has no rows"), (5, "5 rows; a chunk has 4")])
def test_an_update_has_the_scans_of_a_chunk_at_most(drive, count, line):
    odometry, scans = jax.tree.map(lambda x: x[:count], drive)
    state = online.init(CONFIG, START, match_scans=False)
    with pytest.raises(ValueError, match=line):
        online.update(CONFIG, PARAMS, state, odometry, scans)


def test_another_thread_has_the_settings_of_jax_of_this_one():
    def settings():
        return {name: getattr(jax.config, name) for name in chunks.SETTINGS}

    with (
        jax.enable_x64(False),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
        jax.default_matmul_precision("highest"),
        jax.default_device(jax.devices()[1]),
        ThreadPoolExecutor(1) as worker,
    ):
        assert worker.submit(settings).result() != settings()
        assert worker.submit(chunks.with_settings(settings)).result() == settings()
