import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, LineCollection

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering.belief import initial_belief
from jaxslam.frontend.automaton import Diagram
from jaxslam.pipeline.config import Config
from jaxslam.simulation.worlds import World, named
from jaxslam.viz import canvas, charts, maps


@pytest.fixture
def axis():
    return canvas.canvas(4.0, 3.0)[1][0, 0]


def of_type(axis, kind):
    return [item for item in axis.collections if isinstance(item, kind)]


def belief():
    """Two landmarks that count, a node and a corner; a wall, and a node seen once."""
    start = initial_belief(jnp.zeros(3), max_landmarks=4)
    return start._replace(
        mean=start.mean.at[3:].set(jnp.array([1.0, 2.0, 3.0, 4.0, 0.5, 0.0, 9.0, 9.0])),
        map_cov=jnp.diag(jnp.array([0.04, 0.01, 0.01, 0.09, 1.0, 1.0, 1.0, 1.0])),
        num_seen=jnp.array([3, 2, 9, 1]),
        kind=jnp.array([JUNCTION, CORNER, WALL, JUNCTION]),
    )


def test_walls_are_the_world_s(axis):
    world = named("fig07")
    maps.draw_walls(axis, world)
    (drawn,) = of_type(axis, LineCollection)
    np.testing.assert_allclose(np.array(drawn.get_segments()).reshape(-1, 4), world.walls)


def test_landmarks_that_count_are_drawn_with_three_sigma_ellipses(axis):
    maps.draw_landmarks(axis, belief(), confirm_count=2)
    places = [line.get_xydata().tolist() for line in axis.lines]
    assert places == [[[1.0, 2.0]], [[3.0, 4.0]]]
    node, corner = of_type(axis, EllipseCollection)
    assert [*node.get_widths(), *node.get_heights()] == pytest.approx([1.2, 0.6])
    assert [*corner.get_widths(), *corner.get_heights()] == pytest.approx([1.8, 0.6])
    assert node.get_angles()[0] % 180 == pytest.approx(0.0, abs=1e-6)
    assert corner.get_angles()[0] % 180 == pytest.approx(90.0)


@pytest.mark.parametrize("angle", [0.3, 1.2, -0.7])
def test_an_ellipse_is_turned_as_its_covariance(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    cov = turn @ np.diag([0.25, 0.01]) @ turn.T
    maps.draw_ellipses(axis, np.zeros((1, 2)), cov[None], canvas.BLACK)
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
    none = TopologicalMap(*(np.zeros(shape) for shape in ((0,), (0, 2), (0,), (0,))),
                 np.zeros((0, 2), int), np.zeros(0), np.zeros(0), ())  # fmt: skip
    maps.draw_arcs(axis, none)
    maps.draw_landmarks(axis, initial_belief(jnp.zeros(3), max_landmarks=4), confirm_count=2)
    axis.figure.draw_without_rendering()


def test_errors_are_heading_y_x_with_three_sigma_bounds():
    axes = canvas.canvas(4.0, 4.0, 3)[1][:, 0]
    cov = np.tile(np.diag([0.01, 0.04, 0.0001]), (5, 1, 1))
    error = np.tile([0.1, 0.2, 0.02], (5, 1))
    charts.draw_errors(axes, cov, error)
    assert [axis.get_ylabel() for axis in axes] == ["heading [deg]", "y [m]", "x [m]"]
    bounds = [axis.lines[0].get_ydata()[0] for axis in axes]
    assert bounds == pytest.approx([np.degrees(0.03), 0.6, 0.3])
    values = [axis.lines[2].get_ydata()[0] for axis in axes]
    assert values == pytest.approx([np.degrees(0.02), 0.2, 0.1])


def test_errors_without_truth_are_the_bounds_alone():
    axes = canvas.canvas(4.0, 4.0, 3)[1][:, 0]
    charts.draw_errors(axes, np.tile(np.eye(3), (5, 1, 1)))
    assert "error" not in axes[0].get_legend_handles_labels()[1]


def test_echoes_are_moved_to_the_world(axis):
    poses = np.array([[1.0, 2.0, np.pi / 2], [0.0, 0.0, 0.0]])
    points = np.array([[[1.0, 0.0], [5.0, 5.0]], [[3.0, 1.0], [7.0, 7.0]]])
    maps.draw_hits(axis, poses, points, np.array([[True, False], [True, False]]))
    np.testing.assert_allclose(axis.lines[0].get_xydata(), [[1.0, 3.0], [3.0, 1.0]], atol=1e-12)


def test_a_plan_shows_all_in_metres_and_one_scale():
    low, high = canvas.extent(np.array([[0.0, 0.0, 3.0], [20.0, np.nan, 0.0], [10.0, 4.0, 0.0]]))
    assert (low.tolist(), high.tolist()) == ([0.0, 0.0], [10.0, 4.0])
    figure, axis = canvas.map_canvas(low, high)
    assert axis.get_aspect() == 1.0 and "[m]" in axis.get_xlabel() and "[m]" in axis.get_ylabel()
    assert axis.get_xlim()[0] < 0.0 and axis.get_xlim()[1] > 10.0
    assert figure.get_size_inches()[0] * figure.dpi == 900


def test_the_local_diagram_is_drawn_as_the_robot_sees_it(axis, tmp_path):
    config = Config()
    size = config.frontend.grid.shape
    labels = np.zeros(size, np.uint32)
    labels[:, : size[1] // 2], labels[:, size[1] // 2 :] = 1, 2  # right of the robot, left of it
    diagram = Diagram(labels=jnp.asarray(labels), arrival=jnp.zeros(size, jnp.int32))
    sources = np.zeros(size, bool)
    maps.draw_local_diagram(axis, diagram, sources, config.frontend.grid)
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
    way = np.array([[1.0, 1.0, 0.0], [5.0, 1.0, 0.0]])
    for what in maps.TRAJECTORY_STYLES:
        maps.draw_trajectory(axis, way, what)
    maps.draw_start_and_end(axis, way)
    maps.draw_landmarks(axis, belief(), confirm_count=2)
    canvas.legend(figure)
    figure.savefig(tmp_path / "path.png")
    assert (tmp_path / "path.png").stat().st_size > 10_000
