import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxslam.viz import canvas


def test_a_map_shows_all_in_metres_and_one_scale():
    low, high = canvas.extent(np.array([[0.0, 0.0, 3.0], [20.0, np.nan, 0.0], [10.0, 4.0, 0.0]]))
    assert (low.tolist(), high.tolist()) == ([0.0, 0.0], [10.0, 4.0])
    figure, axis = canvas.map_canvas(low, high)
    assert axis.get_aspect() == 1.0 and "[m]" in axis.get_xlabel() and "[m]" in axis.get_ylabel()
    assert axis.get_xlim()[0] < 0.0 and axis.get_xlim()[1] > 10.0
    assert figure.get_size_inches()[0] * figure.dpi == 900


def test_an_extent_is_that_of_arrays_and_lists_alike():
    points = [[1.0, 5.0], [2.0, 4.0]]
    for given in (points, np.array(points), np.float32(points), jnp.array(points)):
        low, high = canvas.extent(given, np.zeros((0, 3)))
        assert (low.tolist(), high.tolist()) == ([1.0, 4.0], [2.0, 5.0])


def test_a_bad_argument_is_named():
    with pytest.raises(ValueError, match=r"groups\[1\] has the shape \(4, 1\)"):
        canvas.extent(np.zeros((2, 2)), np.zeros((4, 1)))
    with pytest.raises(ValueError, match="no finite point"):
        canvas.extent(np.full((2, 2), np.nan))
    with pytest.raises(ValueError, match="low is .*, not"):
        canvas.map_canvas([0.0], [1.0, 1.0])
    for high in ([-1.0, 1.0], [np.nan, 1.0]):
        with pytest.raises(ValueError, match="which is no rectangle"):
            canvas.map_canvas([0.0, 0.0], high)


def test_a_saved_figure_is_as_matplotlib_lays_it_out(tmp_path):
    for name, save in (("own.png", canvas.save), ("plain.png", Figure.savefig)):
        figure, axis = canvas.map_canvas([0.0, 0.0], [3.0, 2.0])
        axis.plot([0.0, 3.0], [0.0, 2.0], label="line")
        canvas.legend(figure)
        save(figure, tmp_path / name)
    assert (tmp_path / "own.png").read_bytes() == (tmp_path / "plain.png").read_bytes()
