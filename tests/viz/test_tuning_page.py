import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from jaxslam.evaluation import consistency_of_nis
from jaxslam.viz import canvas
from jaxslam.viz.consistency_charts import draw_autocorrelation, draw_pit, draw_squares
from jaxslam.viz.parameter_charts import Estimate, draw_correlations, draw_estimates
from jaxslam.viz.tuning_page import TuningPage, tuning_page


def report(scale, *, truth=True):
    rng = np.random.default_rng(0)
    dof = rng.choice([0, 2, 4], (4, 300))
    nis = np.where(dof > 0, scale * rng.chisquare(np.maximum(dof, 1)), 0.0)
    return consistency_of_nis(
        nis,
        dof,
        whitened=np.sqrt(scale) * rng.normal(size=(4, 300, 2)),
        names=("heading", "ahead"),
        nees=scale * rng.chisquare(3, (4, 300)) if truth else None,
        nees_dof=3 if truth else None,
    )


ESTIMATES = [
    Estimate("range", 0.1, 0.02, 0.1, unit="m"),
    Estimate("bearing", 0.1, 0.05, np.inf, identifiable=False),
    Estimate("wall", 0.1, 0.1, frozen=True),
    Estimate("mount[0]", 0.0, 0.25, 0.01, positive=False),
]


def page(**changes):
    whole = TuningPage(
        title="a tuning",
        subtitle="evaluated on others",
        before=report(4.0),
        after=report(1.0),
        estimates=ESTIMATES,
        correlation=np.array([[1.0, 0.5, np.nan], [0.5, 1.0, np.nan], [np.nan] * 3]),
        training=np.array([3.0, 2.0, 1.0]),
        heldout=np.array([3.0, np.nan, 2.0]),
        best=2,
        errors=[("position RMSE [m]", 0.4, 0.1), ("loss", -1.0, None)],
        notes=["not identifiable: bearing"],
    )
    return whole._replace(**changes)


def texts(figure):
    found = [text.get_text() for axis in figure.axes for text in axis.texts]
    found += [axis.get_title(loc="left") for axis in figure.axes]
    return found + [text.get_text() for text in figure.texts]


@pytest.fixture(scope="module")
def drawn():
    figure = tuning_page(page())
    FigureCanvasAgg(figure).draw()
    return figure


def test_the_page_says_what_changed_and_what_is_found(drawn):
    words = texts(drawn)
    assert {
        "a tuning",
        "evaluated on others",
        "position RMSE [m]",
        "0.4",
        "0.1",
        "-75%",
        "Findings before",
    } < set(words)
    assert "not identifiable: bearing" in words and "Warnings" in words
    assert any(text.startswith("Q and R too small, by a common factor of 4") for text in words)
    assert any(text.startswith("consistent: NIS per dof ") for text in words)
    assert "0.1 → 0.02 ± 10%" in words and "0.1, frozen" in words
    assert "0.1 → 0.05, not identifiable" in words and "0 → 0.25 ± 0.01" in words


def test_nothing_on_the_page_overlaps_or_leaves_it(drawn):
    whole, boxes = drawn.bbox, [axis.get_tightbbox() for axis in drawn.axes]
    for box in boxes:
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= whole.x1 and box.y1 <= whole.y1
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            across = min(a.x1, b.x1) - max(a.x0, b.x0)
            along = min(a.y1, b.y1) - max(a.y0, b.y0)
            assert across <= 2 or along <= 2, (a, b)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"before": None, "after": None}, "no measurement was used"),
        (
            {"before": report(1.0, truth=False), "after": report(1.0, truth=False)},
            "no ground truth",
        ),
        ({"correlation": None, "notes": ()}, "Findings after"),
        ({"estimates": ESTIMATES[:1], "correlation": np.eye(1)}, "Parameters"),
        ({"after": report(1.0)._replace(whiteness=None), "before": None}, "Findings before"),
        ({"heldout": np.full(3, np.nan), "errors": []}, "What changed"),
    ],
)
def test_a_page_without_something_is_drawn(changes, words):
    figure = tuning_page(page(**changes))
    assert words in texts(figure)


def test_a_histogram_holds_all_steps_and_its_expected_numbers():
    axis, fit = canvas.canvas(4.0, 3.0)[1][0, 0], report(4.0).nis
    draw_squares(axis, fit, report(1.0).nis)
    after, before = axis.patches
    for each in (after, before):
        assert each.get_data().values.sum() == pytest.approx(100.0)
    assert after.get_data().values[-1] > 5.0, "the last bin holds all beyond"
    assert axis.lines[0].get_ydata().sum() == pytest.approx(100.0)
    labels = axis.get_legend_handles_labels()[1]
    assert labels[0].startswith("after: 4.") and labels[2] == "chi-square, dof 2 to 4, mixed"


def test_a_probability_transform_has_density_one_on_average():
    axis = canvas.canvas(4.0, 3.0)[1][0, 0]
    draw_pit(axis, report(1.0).nis, report(9.0).nis)
    steps = [patch.get_data().values for patch in axis.patches if hasattr(patch, "get_data")]
    assert [values.mean() for values in steps] == pytest.approx([1.0, 1.0])
    assert steps[1][-1] > 4.0 >= axis.get_ylim()[1], "what is higher is cut off"


def test_autocorrelations_are_drawn_from_lag_one_with_their_band():
    axis, white = canvas.canvas(4.0, 3.0)[1][0, 0], report(1.0).whiteness
    draw_autocorrelation(axis, white, white)
    drawn = [line.get_ydata() for line in axis.lines if line.get_label() in white.names]
    np.testing.assert_array_equal(drawn, white.autocorrelation[:, 1:])
    band = axis.collections[0].get_paths()[0].vertices[:, 1]
    assert band.max() == pytest.approx(white.band[:, 1:].max())
    assert "before" in axis.get_legend_handles_labels()[1]


def test_intervals_of_positive_parameters_are_those_of_their_logarithm():
    assert Estimate("a", 1.0, 2.0, 0.5).interval == pytest.approx(
        (2.0 * np.exp(-0.979982), 2.0 * np.exp(0.979982))
    )
    assert Estimate("a", 1.0, 2.0, 0.5, positive=False).interval == pytest.approx(
        (1.020018, 2.979982)
    )
    assert np.isnan(Estimate("a", 1.0, 2.0, np.inf).interval).all()
    axis = canvas.canvas(4.0, 3.0)[1][0, 0]
    draw_estimates(axis, ESTIMATES[:3])
    assert axis.get_xscale() == "log"
    assert [label.get_text() for label in axis.get_yticklabels()] == [
        "range [m]",
        "bearing",
        "wall",
    ]
    axis = canvas.canvas(4.0, 3.0)[1][0, 0]
    draw_estimates(axis, ESTIMATES[3:])
    assert axis.lines[-1].get_xdata()[0] == pytest.approx(25.0), "standard errors"


def test_bad_arguments_are_named():
    axis = canvas.canvas(4.0, 3.0)[1][0, 0]
    with pytest.raises(ValueError, match="estimates are none, or of both kinds"):
        draw_estimates(axis, ESTIMATES)
    with pytest.raises(ValueError, match=r"correlation is .* \(2, 3\), not \(2, 2\)"):
        draw_correlations(axis, ["a", "b"], np.zeros((2, 3)))
