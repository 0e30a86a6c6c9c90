import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.evaluation import consistency
from jaxslam.evaluation.summary import evaluate
from jaxslam.pipeline.episodes import TrialResult


def results_of(trials=4, scans=6):
    """Trials whose errors and covariances are multiples of 1/16, so that float32 holds them."""
    rng = np.random.default_rng(0)
    truth = np.round(rng.normal(size=(trials, scans, 3)) * 16) / 16
    return TrialResult(
        truth=truth,
        estimate=truth + np.array([0.25, 0.0, 0.125]),
        cov=np.tile(np.eye(3) / 16, (trials, scans, 1, 1)),
        dead_reckoning=truth + np.array([0.0, 2.0, 0.0]),
        num_updates=np.full((trials, scans), 2),
        num_landmarks=np.full(trials, 7),
        finite=np.ones(trials, bool),
        truth_mask=np.ones((trials, scans), bool),
        num_steps=np.full(trials, scans),
    )


def test_evaluate_sums_up_errors_and_states_nees_per_degree_of_freedom():
    found = evaluate(results_of())
    assert (found["runs"], found["scans"], found["landmarks"], found["matches"]) == (4, 24, 7, 2)
    assert found["position_rmse_m"] == 0.25
    assert found["heading_rmse_deg"] == pytest.approx(np.degrees(0.125))
    values = consistency.nees(np.array([0.25, 0.0, 0.125]), np.eye(3) / 16)
    assert found["nees"] == pytest.approx(float(consistency.nees_per_dof(values)))
    assert found["nees"] == pytest.approx(1.25 / 3)
    assert found["diverged_runs"] == found["nonfinite_runs"] == []
    assert found["dead_reckoning"]["diverged"] == 4


def test_lists_numpy_and_jax_arrays_give_the_same_summary():
    results = results_of()
    want = evaluate(results)
    for convert in (jnp.asarray, np.ndarray.tolist):
        assert evaluate(TrialResult(*map(convert, results))) == want
    single = TrialResult(*(x.astype(np.float32) if x.dtype == float else x for x in results))
    found = evaluate(single)  # as in production, all in float32
    assert found.pop("dead_reckoning") == pytest.approx(want.pop("dead_reckoning"), rel=1e-6)
    lists = [key for key, value in want.items() if isinstance(value, list)]
    assert all(found.pop(key) == want.pop(key) for key in lists)
    assert found == pytest.approx(want, rel=1e-6)


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"truth": np.zeros((4, 3))}, r"results.truth is float64 \(4, 3\), not .*\(B, T, 3\)"),
        (
            {"estimate": np.zeros((4, 5, 3))},
            r"results.estimate is .* \(4, 5, 3\), not .*\(4, 6, 3\)",
        ),
        ({"cov": np.zeros((4, 6, 3))}, r"results.cov is .*, not floating \(4, 6, 3, 3\)"),
        ({"finite": np.ones(4)}, r"results.finite is float64 \(4,\), not bool \(4,\)"),
        ({"num_steps": np.full(3, 6)}, r"results.num_steps is .* \(3,\), not integer \(4,\)"),
        ({"truth_mask": np.ones(6, bool)}, r"results.truth_mask is bool \(6,\), not"),
    ],
)
def test_evaluate_names_the_array_that_does_not_fit(wrong, problem):
    with pytest.raises(ValueError, match=problem):
        evaluate(results_of()._replace(**wrong))


def test_evaluate_refuses_no_trials_no_scans_and_other_records():
    for trials, scans in ((0, 6), (4, 0)):
        empty = jax.tree.map(lambda x: x, results_of(trials, scans))
        with pytest.raises(ValueError, match=f"empty: {trials} trials of {scans} scans"):
            evaluate(empty)
    with pytest.raises(ValueError, match="results is of type tuple, not TrialResult"):
        evaluate(tuple(results_of()))


def result_of(final, *, finite=True, nan=False):
    """A trial of two scans whose last estimate is `final` [m] off, dead reckoning twice that."""
    estimate = np.zeros((2, 3))
    estimate[1, 0] = np.nan if nan else final
    odometry = np.zeros((2, 3))
    odometry[1, 0] = 2 * final
    return TrialResult(
        truth=np.zeros((2, 3)),
        estimate=estimate,
        cov=np.stack([np.zeros((3, 3)), np.diag([0.04, 0.04, 0.01])]),
        dead_reckoning=odometry,
        num_updates=np.array([0, 3], np.int32),
        num_landmarks=np.int32(4),
        finite=np.bool_(finite),
        truth_mask=np.ones(2, bool),
        num_steps=np.int32(2),
    )


def summary_of(*results):
    return evaluate(jax.tree.map(lambda *x: np.stack(x), *results))


def test_evaluate_counts_diverged_and_nonfinite_trials_and_masks_the_latter():
    nonfinite = result_of(0.0, nan=True), result_of(0.0, finite=False)
    summary = summary_of(result_of(0.2), result_of(1.5), *nonfinite, result_of(-0.4))
    good = np.array([0.2, 1.5, -0.4])
    assert summary["runs"] == 5 and summary["diverged_runs"] == [1, 2, 3]
    assert summary["nonfinite_runs"] == [2, 3] and summary["nonfinite"] == 2
    assert summary["diverged"] == 3 and summary["dead_reckoning"]["diverged"] == 1
    assert summary["position_rmse_m"] == pytest.approx(np.sqrt(np.mean(good**2) / 2))
    assert summary["heading_rmse_deg"] == 0
    # The certain first pose has no NEES.
    assert summary["nees"] == pytest.approx(np.mean(good**2 / 0.04) / 3)
    assert summary["landmarks"] == 4 and summary["matches"] == 1.5
    assert summary["dead_reckoning"]["position_rmse_m"] == pytest.approx(
        2 * summary["position_rmse_m"]
    )


def test_padding_and_trials_without_truth_do_not_count():
    """Drives of two and of five scans, as `stack_episodes` pads them, and one without truth."""

    def fill(x):
        x = np.asarray(x)
        ends = [(0, 3 if x.ndim and len(x) == 2 else 0)] + [(0, 0)] * (x.ndim - 1)
        return np.pad(x, ends) if x.ndim else x

    short = result_of(0.2)
    padded = jax.tree.map(fill, short)
    padded.estimate[2:] = padded.estimate[1]
    long = padded._replace(
        truth_mask=np.ones(5, bool), num_steps=np.int32(5), estimate=np.zeros((5, 3))
    )
    blind = padded._replace(truth_mask=np.zeros(5, bool), estimate=np.full((5, 3), 7.0))
    alone, both = summary_of(short), summary_of(padded, blind)
    for key in ("position_rmse_m", "heading_rmse_deg", "nees", "diverged", "matches"):
        assert both[key] == alone[key], key
    assert both["scans"] == 4 and both["dead_reckoning"] == alone["dead_reckoning"]
    assert summary_of(padded, long)["scans"] == 7 and summary_of(padded, long)["matches"] == 6 / 7
    nothing = summary_of(blind)
    assert nothing["position_rmse_m"] is None and nothing["nees"] is None
    assert nothing["diverged"] == 0
