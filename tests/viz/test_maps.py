import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, LineCollection

from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering.belief import initial_belief
from jaxslam.frontend.automaton import Diagram
from jaxslam.pipeline.config import Config
from jaxslam.simulation.worlds import World, named
from jaxslam.viz import canvas, landmarks, maps


@pytest.fixture
def axis():
    return canvas.canvas(4.0, 3.0)[1][0, 0]


def of_type(axis, kind):
    return [item for item in axis.collections if isinstance(item, kind)]


def belief():
    """Two confirmed landmarks, a junction and a corner; a wall, and a junction seen once."""
    start = initial_belief(jnp.zeros(3), max_landmarks=4)
    return start._replace(
        mean=start.mean.at[3:].set(jnp.array([1.0, 2.0, 3.0, 4.0, 0.5, 0.0, 9.0, 9.0])),
        map_cov=jnp.diag(jnp.array([0.04, 0.01, 0.01, 0.09, 1.0, 1.0, 1.0, 1.0])),
        num_seen=jnp.array([3, 2, 9, 1]),
        kind=jnp.array([JUNCTION, CORNER, WALL, JUNCTION]),
    )


def test_walls_are_those_of_the_world(axis):
    world = named("fig07")
    maps.draw_walls(axis, world)
    (drawn,) = of_type(axis, LineCollection)
    np.testing.assert_allclose(np.array(drawn.get_segments()).reshape(-1, 4), world.walls)


def test_wrong_parts_of_a_trajectory_are_marked_in_red(axis):
    poses = np.arange(18.0).reshape(6, 3)
    maps.draw_wrong_parts(axis, poses, [(1, 3), (5, 5)])
    drawn = [line.get_xydata() for line in axis.lines]
    np.testing.assert_allclose(drawn[0], poses[1:4, :2])
    np.testing.assert_allclose(drawn[1], poses[5:, :2])
    assert {line.get_color() for line in axis.lines} == {canvas.RED}
    assert [line.get_label() for line in axis.lines] == ["map contradicts itself", "_wrong"]


def test_poses_are_coloured_by_their_probability_the_likely_ones_on_top(axis):
    poses, probability = np.arange(9.0).reshape(3, 3), np.array([0.9, 0.1, 0.5])
    maps.draw_probable_poses(axis, poses, probability)
    (dots,) = axis.collections
    np.testing.assert_array_equal(dots.get_offsets(), poses[[1, 2, 0], :2])
    np.testing.assert_array_equal(dots.get_array(), [0.1, 0.5, 0.9])
    assert dots.get_clim() == (0.0, 1.0)
    with pytest.raises(ValueError, match="probability"):
        maps.draw_probable_poses(axis, poses, probability[:2])


def test_confirmed_landmarks_are_drawn_with_three_sigma_ellipses(axis):
    landmarks.draw_landmarks(axis, belief(), confirm_count=2)
    positions = [line.get_xydata().tolist() for line in axis.lines]
    assert positions == [[[1.0, 2.0]], [[3.0, 4.0]]]
    junction, corner = of_type(axis, EllipseCollection)
    assert [*junction.get_widths(), *junction.get_heights()] == pytest.approx([1.2, 0.6])
    assert [*corner.get_widths(), *corner.get_heights()] == pytest.approx([1.8, 0.6])
    assert junction.get_angles()[0] % 180 == pytest.approx(0.0, abs=1e-6)
    assert corner.get_angles()[0] % 180 == pytest.approx(90.0)


@pytest.mark.parametrize("angle", [0.3, 1.2, -0.7])
def test_an_ellipse_is_turned_as_its_covariance(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    cov = turn @ np.diag([0.25, 0.01]) @ turn.T
    landmarks.draw_ellipses(axis, np.zeros((1, 2)), cov[None], canvas.BLACK)
    (drawn,) = of_type(axis, EllipseCollection)
    assert np.tan(np.radians(drawn.get_angles()[0])) == pytest.approx(np.tan(angle))
    assert drawn.get_widths()[0] == pytest.approx(2 * 3 * 0.5)


def test_arcs_are_drawn_along_their_lines(axis):
    graph = TopologicalMap(
        id=np.array([5, 8]),
        xy=np.array([[0.0, 0.0], [2.0, 0.0]]),
        kind=np.array([JUNCTION, JUNCTION]),
        clearance=np.ones(2),
        arc_ends=np.array([[0, 1]]),
        arc_length=np.array([2.8]),
        arc_clearance=np.ones(1),
        arc_lines=(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 0.0]]),),
    )
    maps.draw_arcs(axis, graph)
    (drawn,) = of_type(axis, LineCollection)
    np.testing.assert_allclose(drawn.get_segments(), [[[0.0, 0.0], [1.0, 1.0], [2.0, 0.0]]])


def test_an_empty_map_draws_nothing(axis):
    none = TopologicalMap(
        id=np.zeros(0, int),
        xy=np.zeros((0, 2)),
        kind=np.zeros(0, int),
        clearance=np.zeros(0),
        arc_ends=np.zeros((0, 2), int),
        arc_length=np.zeros(0),
        arc_clearance=np.zeros(0),
        arc_lines=(),
    )
    maps.draw_arcs(axis, none)
    landmarks.draw_landmarks(axis, initial_belief(jnp.zeros(3), max_landmarks=4), confirm_count=2)
    axis.figure.draw_without_rendering()


def test_hits_are_moved_to_the_world(axis):
    poses = np.array([[1.0, 2.0, np.pi / 2], [0.0, 0.0, 0.0]])
    points = np.array([[[1.0, 0.0], [5.0, 5.0]], [[3.0, 1.0], [7.0, 7.0]]])
    maps.draw_hits(axis, poses, points, np.array([[True, False], [True, False]]))
    np.testing.assert_allclose(axis.lines[0].get_xydata(), [[1.0, 3.0], [3.0, 1.0]], atol=1e-12)


def test_the_local_diagram_is_drawn_as_the_robot_sees_it(axis, tmp_path):
    config = Config()
    size = config.frontend.grid.shape
    labels = np.zeros(size, np.uint32)
    labels[:, : size[1] // 2], labels[:, size[1] // 2 :] = 1, 2  # right of the robot, left of it
    diagram = Diagram(labels=jnp.asarray(labels), arrival=jnp.zeros(size, jnp.int32))
    sources = np.zeros(size, bool)
    landmarks.draw_local_diagram(axis, diagram, sources, config.frontend.grid)
    image = axis.images[0].get_array()
    middle = size[1] // 2
    dark = np.flatnonzero((image[size[0] // 2] == 0.0).all(axis=-1))
    assert set(dark) <= {middle - 1, middle} and len(dark) == 1
    assert axis.get_xlim()[0] > axis.get_xlim()[1]  # y grows to the left
    axis.figure.savefig(tmp_path / "local.png")


def test_a_whole_picture_is_written(tmp_path):
    world = World(named("office").walls)
    figure, axis = canvas.map_canvas(*canvas.extent(world.walls.reshape(-1, 2)))
    maps.draw_walls(axis, world)
    poses = np.array([[1.0, 1.0, 0.0], [5.0, 1.0, 0.0]])
    for what in maps.TRAJECTORY_STYLES:
        maps.draw_trajectory(axis, poses, what)
    maps.draw_start_and_end(axis, poses)
    landmarks.draw_landmarks(axis, belief(), confirm_count=2)
    canvas.legend(figure)
    figure.savefig(tmp_path / "path.png")
    assert (tmp_path / "path.png").stat().st_size > 10_000


@pytest.mark.parametrize("convert", [np.asarray, jnp.asarray, np.ndarray.tolist])
def test_trajectories_and_hits_are_drawn_from_any_kind_of_array(axis, convert):
    poses = np.array([[1.0, 2.0, 0.5], [3.0, 1.0, 0.25]])
    points, hit = np.ones((2, 3, 2)), np.ones((2, 3), bool)
    maps.draw_trajectory(axis, convert(poses), "estimate")
    maps.draw_hits(axis, convert(poses), convert(points), convert(hit))
    maps.draw_robot(axis, convert(poses[0]), convert(points[0]))
    np.testing.assert_array_equal(axis.lines[0].get_xydata(), poses[:, :2])
    assert len(axis.lines[1].get_xydata()) == 6


POSES, POINTS, HIT = np.zeros((2, 3)), np.zeros((2, 4, 2)), np.zeros((2, 4), bool)
GRID = OccupancyMap(np.zeros((3, 2), bool), np.zeros((3, 2), bool), 0.5, np.zeros(3))


@pytest.mark.parametrize(
    "draw, given, message",
    [
        (maps.draw_trajectory, (POSES[:, :2], "truth"), r"poses is .* \(2, 2\), not \(T, 3\)"),
        (maps.draw_trajectory, (POSES, "wheels"), "what is 'wheels', not one of estimate, truth"),
        (maps.draw_hits, (POSES[:, :2], POINTS, HIT), "poses is"),
        (maps.draw_hits, (POSES, POINTS, HIT[:1]), r"hit is bool \(1, 4\)"),
        (maps.draw_hits, (POSES, POINTS, HIT.astype(int)), "hit is int"),
        (maps.draw_hits, (POSES, POINTS[:, :3], HIT), r"points is .* \(2, 3, 2\)"),
        (maps.draw_robot, (POSES, POINTS[0]), r"pose is .* \(2, 3\), not \(3,\)"),
        (maps.draw_robot, (POSES[0], POINTS), "ends is"),
        (maps.draw_start_and_end, (POSES[:0],), "poses is empty"),
        (landmarks.draw_ellipses, (POSES, np.eye(2), "red"), "xy is"),
        (landmarks.draw_ellipses, (POSES[:, :2], np.eye(2), "red"), "cov is"),
        (maps.draw_walls, (World(np.zeros((3, 2))),), r"world.walls is .* \(3, 2\), not \(N, 4\)"),
        (maps.draw_occupancy, (GRID._replace(free=HIT),), "grid.free is"),
        (maps.draw_occupancy, (GRID._replace(origin=[0.0, 1.0]),), "grid.origin is"),
    ],
)
def test_a_bad_argument_is_named(axis, draw, given, message):
    with pytest.raises(ValueError, match=message):
        draw(axis, *given)


def test_a_grid_without_known_cells_has_no_corners():
    with pytest.raises(ValueError, match="grid has no known cell"):
        maps.known_corners(GRID)


def test_a_diagram_of_another_grid_is_refused(axis):
    diagram = Diagram(labels=jnp.zeros((3, 3), jnp.uint32), arrival=jnp.zeros((3, 3), jnp.int32))
    with pytest.raises(ValueError, match="diagram.labels is uint32"):
        landmarks.draw_local_diagram(axis, diagram, np.zeros((3, 3), bool), Config().frontend.grid)


def test_a_large_grid_is_drawn_in_squares_that_keep_thin_walls(axis):
    free = np.ones((4500, 20), bool)
    free[3001] = False  # a wall of one cell
    maps.draw_occupancy(axis, OccupancyMap(~free, free, 0.05, np.array([1.0, 2.0, 0.0])))
    (image,) = axis.images
    pixels = np.asarray(image.get_array()).T
    assert pixels.shape == (1500, 7)
    np.testing.assert_array_equal(np.flatnonzero((pixels == pixels.min()).all(axis=1)), [1000])
    far = (image.get_transform() - axis.transData).transform(image.get_extent()[1::2])
    np.testing.assert_allclose(far, [1.0 + 225.0, 2.0 + 1.05])
