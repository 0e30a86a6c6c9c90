"""The whole map of a robot on its drive: the same graph, when more is seen and when poses move."""

import jax
import jax.numpy as jnp
import networkx
import numpy as np
import pytest

from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose, increments
from jaxslam.core.types import JUNCTION
from jaxslam.filtering.noise import NoiseParams
from jaxslam.mapping.global_map import moved_with_poses
from jaxslam.pipeline import online
from jaxslam.pipeline.config import Config
from jaxslam.simulation import ray_casting
from jaxslam.simulation.worlds import World, outline

LIDAR = Lidar(num_beams=181, angle_min=-np.pi, angle_increment=np.pi / 90, range_max=8.0)
CONFIG = Config.for_laser_log(LIDAR)
T_SHAPE = (0.0, 0.0, 12.0, 2.0), (5.0, 2.0, 7.0, 7.0)
PATH = np.array([[x, 1.0, 0.0] for x in np.arange(1.0, 11.0, 0.5)])
pytestmark = pytest.mark.slow  # it compiles for half a minute


@pytest.fixture(scope="module")
def drive():
    """State, map, poses and ranges after half of a drive through a T, and after all of it."""
    world = World(jnp.asarray(outline(T_SHAPE)))
    scan = jax.vmap(lambda pose: ray_casting.cast(LIDAR, world, pose))(jnp.asarray(PATH))
    ranges = np.where(scan.hit, scan.ranges, np.nan)
    params = NoiseParams.for_laser_log(match_scans=True)
    state, found, poses, after = online.init(CONFIG, PATH[0]), None, np.zeros((0, 3)), []
    for part in np.split(np.arange(len(PATH)), 2):
        earlier = {} if found is None else {"previous": found.graph, "previous_poses": poses}
        state, result = online.update(CONFIG, params, state, increments(PATH)[part], ranges[part])
        poses = np.concatenate([poses, np.asarray(result.info.pose, float)])
        before = int(state.belief.next_id)
        state, found = online.whole_map(CONFIG, state, poses, ranges[: len(poses)], **earlier)
        assert int(state.belief.next_id) == found.next_id >= before
        after.append((state, found, poses, ranges[: len(poses)]))
    return after


def test_the_map_grows_and_stays_the_same_graph(drive):
    (_, first, *_), (_, later, *_) = drive
    net = networkx.MultiGraph(later.graph.arc_ends.tolist())
    assert networkx.is_connected(net)
    assert set(net) == set(np.flatnonzero(later.graph.kind == JUNCTION).tolist())
    before = {int(k): xy for k, xy in zip(first.graph.id, first.graph.xy, strict=True)}
    kept = [
        np.hypot(*(xy - before[int(k)]))
        for k, xy in zip(later.graph.id, later.graph.xy, strict=True)
        if int(k) in before
    ]
    assert len(kept) >= 0.5 * len(before) and max(kept) < 0.5
    assert first.graph.frontiers  # the rest of the corridors


def test_the_map_moves_with_the_poses(drive):
    state, first, poses, ranges = drive[1]
    shift = np.array([0.4, -0.3, 0.2])
    moved = compose(shift[None], poses)
    turn = np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]])
    found = moved_with_poses(first.graph, poses, moved)
    np.testing.assert_allclose(found.xy, first.graph.xy @ turn + shift[:2], atol=1e-9)
    nothing = online.init(CONFIG, moved[0])._replace(arcs=state.arcs)
    nothing = nothing._replace(belief=nothing.belief._replace(next_id=state.belief.next_id))
    _, again = online.whole_map(
        CONFIG, nothing, moved, ranges, previous=first.graph, previous_poses=poses
    )
    assert np.isin(again.graph.id, first.graph.id).mean() > 0.5
    assert again.next_id >= first.next_id


def test_poses_that_do_not_fit_are_refused(drive):
    state, found, poses, ranges = drive[0]
    with pytest.raises(ValueError, match="previous_poses has 11 rows, poses 10"):
        online.whole_map(
            CONFIG, state, poses, ranges, previous=found.graph, previous_poses=PATH[:11]
        )
    with pytest.raises(ValueError, match="10 rows and ranges 9 scans"):
        online.whole_map(CONFIG, state, poses, ranges[:9])
