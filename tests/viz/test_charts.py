import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.viz import canvas, charts


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


def test_losses_are_drawn_where_they_were_evaluated():
    axis = canvas.canvas(4.0, 3.0)[1][0, 0]
    charts.draw_losses(axis, [3.0, 2.0, 1.0], jnp.array([jnp.nan, 4.0, 5.0]), 2)
    training, heldout, best = axis.lines
    assert training.get_ydata().tolist() == [3.0, 2.0, 1.0]
    assert heldout.get_xydata().tolist() == [[1.0, 4.0], [2.0, 5.0]]
    assert best.get_xdata() == [2, 2]


def test_parameters_are_relative_to_their_initial_values():
    axis = canvas.canvas(4.0, 3.0)[1][0, 0]
    charts.draw_parameters(axis, ("a", "b"), [[2.0, 10.0], [3.0, 5.0]], 1)
    assert [line.get_ydata().tolist() for line in axis.lines[:2]] == [[1.0, 1.5], [1.0, 0.5]]
    assert axis.get_legend_handles_labels()[1] == ["a", "b"] and axis.get_yscale() == "log"


def test_a_bad_argument_is_named():
    axes = canvas.canvas(4.0, 4.0, 3)[1][:, 0]
    with pytest.raises(ValueError, match="axes has 2 axes, not 3"):
        charts.draw_errors(axes[:2], np.zeros((5, 3, 3)))
    with pytest.raises(ValueError, match=r"cov is .* \(5, 3\), not \(T, 3, 3\)"):
        charts.draw_errors(axes, np.zeros((5, 3)))
    with pytest.raises(ValueError, match=r"error is .* \(4, 3\), not \(5, 3\)"):
        charts.draw_errors(axes, np.zeros((5, 3, 3)), np.zeros((4, 3)))
    with pytest.raises(ValueError, match="heldout is"):
        charts.draw_losses(axes[0], np.zeros(5), np.zeros(4), 0)
    with pytest.raises(ValueError, match="history is"):
        charts.draw_parameters(axes[0], ("a",), np.zeros((5, 2)), 0)
