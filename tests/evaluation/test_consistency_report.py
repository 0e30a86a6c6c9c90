import numpy as np
import pytest
from scipy import stats

from jaxslam.evaluation import consistency_of_nis, consistency_report, report_metrics
from jaxslam.evaluation import filter_consistency as module
from jaxslam.evaluation.chi_square_fit import histogram
from jaxslam.evaluation.whiteness import autocorrelation, ljung_box, std_error

F = np.array([[1.0, 0.1], [0.0, 1.0]])
Q = np.diag([1e-6, 1e-2])
R = np.diag([0.04, 0.09])  # of position and velocity, both measured


def kalman(seed, *, trials=20, steps=100, q=1.0, r=1.0, bias=0.0, neighbours=0.0, size=2):
    """A textbook's filter, whose Q and R are `q` and `r` times those of the simulated system.

    Returns innovations (B, T, m), their covariances, errors (B, T, 2) and their covariances.
    """
    rng, H, noise_cov = np.random.default_rng(seed), np.eye(2)[:size], R[:size, :size]
    x = np.zeros((trials, 2))
    P = np.diag([0.5, 0.5])
    m = x + rng.multivariate_normal(np.zeros(2), P, trials)
    n = rng.multivariate_normal(np.zeros(size), noise_cov, trials)
    found = []
    for _ in range(steps):
        x = x @ F.T + rng.multivariate_normal(np.zeros(2), Q, trials)
        fresh = rng.multivariate_normal(np.zeros(size), noise_cov, trials)
        n = neighbours * n + np.sqrt(1.0 - neighbours**2) * fresh
        z = x @ H.T + n
        z[:, -1] += bias
        m, P = m @ F.T, F @ P @ F.T + q * Q
        S, v = H @ P @ H.T + r * noise_cov, z - m @ H.T
        K = P @ H.T @ np.linalg.inv(S)
        m, P = m + v @ K.T, P - K @ S @ K.T
        found.append((v, np.tile(S, (trials, 1, 1)), m - x, np.tile(P, (trials, 1, 1))))
    return tuple(np.stack(each, axis=1) for each in zip(*found, strict=True))


def report_of(seed, **kwargs):
    v, S, e, P = kalman(seed, **kwargs)
    return consistency_report(v, S, errors=e, error_covariances=P)


def test_a_correct_filter_is_consistent_in_standard_errors():
    reports = [report_of(seed) for seed in range(12)]
    for name in ("nis", "nees"):
        fits = [getattr(report, name) for report in reports]
        scores = np.array([(fit.per_dof - 1.0) / fit.std_error for fit in fits])
        assert np.abs(scores.mean()) < 3.0 / np.sqrt(len(fits)) and 0.5 < scores.std() < 1.7
        inside = np.array([(fit.inside - 0.95) / fit.inside_std_error for fit in fits])
        assert np.abs(inside.mean()) < 4.0 / np.sqrt(len(fits)) and inside.std() < 2.0
        assert np.mean([fit.ks_p for fit in fits]) > 0.3
    means = np.stack(
        [report.whiteness.mean / report.whiteness.mean_std_error for report in reports]
    )
    assert np.abs(means.mean()) < 3.0 / np.sqrt(means.size) and 0.6 < means.std() < 1.5
    r = np.stack([report.whiteness.autocorrelation[:, 1:] for report in reports])
    band = np.stack([report.whiteness.band[:, 1:] for report in reports])
    share = np.mean(np.abs(r) > band)
    expected = 2 * stats.norm.sf(2.0)
    assert abs(share - expected) < 4.0 * np.sqrt(expected * (1 - expected) / r.size)
    p = [report.whiteness.ljung_box_p for report in reports]
    assert stats.kstest(p, "uniform").pvalue > 0.003
    assert sum(report.consistent for report in reports) >= len(reports) - 1
    good = next(report for report in reports if report.consistent)
    assert len(good.verdicts) == 1 and good.verdicts[0].startswith("consistent: NIS per dof ")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "wrong, cause, sign",
    [
        ({"q": 0.02}, "Q too small, or noise that is itself correlated", 1),
        ({"q": 50.0}, "Q too large", -1),
        ({"r": 0.2}, "R too small", -1),
        ({"r": 5.0}, "R too large, or noise that is itself correlated", 1),
        ({"q": 0.5, "r": 0.5}, "Q and R too small, by a common factor of 2", 0),
        ({"q": 3.0, "r": 3.0}, "Q and R too large, by a common factor of 2.", 0),
        ({"q": 1.0, "neighbours": 0.7}, "R too large, or noise that is itself correlated", 1),
    ],
)
def test_wrong_noise_gets_its_verdict(wrong, cause, sign, seed):
    report = report_of(seed, size=1, trials=40, **wrong)
    assert not report.consistent and report.verdicts[0].startswith(cause)
    correlated = [line for line in report.verdicts if " correlated at lag" in line]
    assert len(correlated) == abs(sign)
    assert all(f" {'+' if sign > 0 else '-'}0." in line for line in correlated)
    confident = report.nees.per_dof > 1.0
    word = "over-confident" if confident else "too cautious"
    assert any(line.startswith(word) for line in report.verdicts)


@pytest.mark.parametrize("seed", range(3))
def test_a_bias_is_named_and_explains_the_size_of_the_innovations(seed):
    report = report_of(seed, bias=0.4)
    assert not report.consistent
    assert report.verdicts[0].startswith("innovations too large by their bias: NIS per dof ")
    line = next(line for line in report.verdicts if line.startswith("a bias: "))
    assert "component 1 +" in line and "component 0 -" in line, "the two measure one velocity"
    others = [text for text in report.verdicts if "Q" in text or "R too" in text]
    assert all(text.startswith("innovations are") and "the bias, or" in text for text in others)


def test_a_bias_does_not_explain_innovations_that_are_too_small():
    v = 0.5 * np.random.default_rng(0).normal(size=(2000, 1)) + 0.1
    first, second = consistency_report(v, np.eye(1)).verdicts
    assert first.startswith("Q and R too large, by a common factor of 4: innovations are too small")
    assert second.startswith("a bias: innovations have the mean component 0 +0.")


def test_a_bias_that_the_state_absorbs_shows_in_nees_alone():
    report = report_of(0, bias=0.2, size=1, trials=40, steps=200)
    assert len(report.verdicts) == 1 and report.verdicts[0].startswith("over-confident: ")
    assert "no innovation shows it" in report.verdicts[0]


def test_outliers_and_noise_that_varies_are_named():
    rng = np.random.default_rng(0)
    v = rng.standard_t(3.0, (4000, 1)) / np.sqrt(3.0)
    report = consistency_report(v, np.eye(1))
    assert any("both tails are heavy" in line or "NIS" in line for line in report.verdicts)
    scale = np.repeat(rng.uniform(0.3, 1.4, 100), 40)[:, None]
    v = rng.normal(size=(4000, 1)) * scale / np.sqrt(np.mean(scale**2))
    assert any(
        line.startswith("NIS is ") and "noise that varies in time" in line
        for line in consistency_report(v, np.eye(1)).verdicts
    )
    x = rng.normal(size=4000)
    for t in range(1, 4000):
        x[t] += 0.5 * x[t - 1]  # correlated, but of constant size
    x = x[:, None] * np.sqrt(0.75)
    scale = np.repeat(np.exp(rng.normal(size=100)), 40)[:, None]
    for v, varies in ((x, False), (x * scale / np.sqrt(np.mean(scale**2)), True)):
        lines = consistency_report(v, np.eye(1)).verdicts
        assert any(line.startswith("innovations are correlated at") for line in lines)
        assert any(line.startswith("NIS is correlated at") for line in lines) == varies


def test_masked_steps_equal_deleted_ones():
    v, S, e, P = kalman(3, trials=1)
    keep = np.random.default_rng(1).uniform(size=v.shape[1]) < 0.6
    spoiled, spoiled_cov = np.where(keep[:, None], v[0], np.nan), S[0] * 1.0
    spoiled_cov[~keep] = -np.inf
    masked = consistency_report(
        spoiled, spoiled_cov, mask=keep, errors=e[0], error_covariances=P[0]
    )
    fewer = consistency_report(v[0, keep], S[0, keep], errors=e[0], error_covariances=P[0])
    assert report_metrics(masked) == report_metrics(fewer)
    np.testing.assert_array_equal(np.isnan(masked.nis.values[0]), ~keep)
    np.testing.assert_array_equal(masked.nis.dof[0], np.where(keep, 2, 0))


def test_masked_numbers_equal_a_smaller_measurement():
    v, S, _, _ = kalman(4, trials=3)
    mask = np.broadcast_to([True, False], v.shape)
    masked = consistency_report(v, S, mask=mask)
    small = consistency_report(v[..., :1], S[..., :1, :1])
    np.testing.assert_allclose(masked.nis.values, small.nis.values)
    np.testing.assert_array_equal(masked.nis.dof, 1)
    np.testing.assert_allclose(
        masked.whiteness.autocorrelation[0], small.whiteness.autocorrelation[0]
    )
    assert masked.whiteness.num_values.tolist() == [300, 0]
    assert np.isnan(masked.whiteness.mean[1]) and masked.consistent == small.consistent
    mixed = np.random.default_rng(0).uniform(size=v.shape) < 0.7
    report = consistency_report(v, S, mask=mixed)
    for b, t in ((0, 5), (2, 70), (1, 33)):
        has = mixed[b, t]
        part, cov = v[b, t, has], S[b, t][np.ix_(has, has)]
        expected = part @ np.linalg.solve(cov, part) if has.any() else np.nan
        np.testing.assert_allclose(report.nis.values[b, t], expected)
    assert set(np.unique(report.nis.dof)) == {0, 1, 2} and report.consistent


def test_nis_its_transform_and_its_fit_equal_scipy():
    v, S, e, P = kalman(5, trials=2)
    report = consistency_report(v, S, errors=e, error_covariances=P)
    nis = np.einsum("bti,btij,btj->bt", v, np.linalg.inv(S), v)
    np.testing.assert_allclose(report.nis.values, nis)
    np.testing.assert_allclose(report.nis.pit, stats.chi2.cdf(nis, 2))
    assert report.nis.per_dof == pytest.approx(nis.mean() / 2)
    low, high = stats.chi2.interval(0.95, 2)
    assert report.nis.inside == np.mean((nis > low) & (nis < high))
    test = stats.kstest(stats.chi2.cdf(nis, 2).ravel(), "uniform")
    assert report.nis.ks == pytest.approx(test.statistic)
    assert report.nis.ks_p >= 0.9 * test.pvalue, "autocorrelation only takes from N"
    np.testing.assert_allclose(
        report.nees.values, np.einsum("bti,btij,btj->bt", e, np.linalg.inv(P), e)
    )
    scores = module.normal_scores(report.nis)
    np.testing.assert_allclose(stats.norm.cdf(scores), report.nis.pit, atol=1e-12)
    far = consistency_of_nis([300.0, 1e4, 0.0], 2)
    np.testing.assert_allclose(module.normal_scores(far.nis)[0], [8.0, 8.0, -8.0])


def test_autocorrelation_and_ljung_box_equal_their_formulas():
    x, lags = np.random.default_rng(2).normal(size=80), 10
    r, pairs = autocorrelation(x[None], np.ones((1, 80), bool), lags)
    centred = x - x.mean()
    usual = np.array([np.sum(centred[: 80 - l] * centred[l:]) for l in range(lags + 1)])
    usual /= np.sum(centred**2)  # of the textbooks and of statsmodels
    np.testing.assert_allclose(r * pairs / 80, usual)
    statistic, dof, p = ljung_box(r[None], pairs[None])
    expected = 80 * 82 * np.sum(usual[1:] ** 2 / (80 - np.arange(1, lags + 1)))
    assert statistic == pytest.approx(expected) and dof == lags
    assert p == pytest.approx(stats.chi2.sf(expected, lags))


@pytest.mark.parametrize("trials, neighbours", [(1, 0.0), (1, 0.8), (1, -0.5), (30, 0.9)])
def test_standard_errors_allow_for_autocorrelation(trials, neighbours):
    rng, steps, found, means = np.random.default_rng(6), 400 if trials == 1 else 40, [], []
    for _ in range(300):
        noise = rng.normal(size=(trials, steps + 50))
        x = np.zeros_like(noise)
        for t in range(1, steps + 50):
            x[:, t] = neighbours * x[:, t - 1] + noise[:, t]
        x = x[:, 50:]
        means.append(x.mean())
        found.append(std_error(x - x.mean(), np.ones(x.shape, bool)))
    spread = np.std(means)
    assert np.mean(found) == pytest.approx(spread, rel=4.0 / np.sqrt(2 * 300) + 0.08)


def test_histograms_count_what_chi_square_expects():
    rng = np.random.default_rng(7)
    dof = rng.choice([0, 1, 2, 6], (4, 2000))
    nis = np.where(dof > 0, rng.chisquare(np.maximum(dof, 1)), np.nan)
    report = consistency_of_nis(nis, dof)
    assert report.consistent and report.nis.num_values == np.sum(dof > 0)
    assert report.nis.per_dof == pytest.approx(np.nansum(nis) / dof.sum())
    for degrees in (None, 1, 6):
        edges, counts, expected = histogram(report.nis, degrees)
        number = np.sum(dof > 0) if degrees is None else np.sum(dof == degrees)
        assert counts.sum() == number and expected.sum() == pytest.approx(number)
        used = expected > 5
        statistic = np.sum((counts - expected)[used] ** 2 / expected[used])
        assert stats.chi2.sf(statistic, used.sum() - 1) > 1e-3
    np.testing.assert_allclose(
        histogram(report.nis, 2, np.array([0.0, 1.0, np.inf]))[2],
        np.sum(dof == 2) * np.diff(stats.chi2.cdf([0.0, 1.0, np.inf], 2)),
    )
    with pytest.raises(ValueError, match=r"dof is 3, but the values have \[1, 2, 6\]"):
        histogram(report.nis, 3)


def test_numbers_of_nis_alone_equal_those_of_the_full_report():
    v, S, e, P = kalman(8, trials=2)
    full = report_metrics(consistency_report(v, S, errors=e, error_covariances=P))
    nis = np.einsum("bti,btij,btj->bt", v, np.linalg.inv(S), v)
    alone = report_metrics(consistency_of_nis(nis, np.full(nis.shape, 2)))
    shared = alone.keys() - {"verdicts"}
    assert {"nis_per_dof", "nis_per_dof_interval", "nis_ks_p"} < shared < full.keys()
    assert full.keys() - shared >= {"nees_per_dof", "autocorrelation", "ljung_box_p", "bias"}
    for key in shared - {"consistent"}:
        np.testing.assert_allclose(alone[key], full[key])
    wrong = consistency_of_nis(3 * nis, 2)
    assert wrong.verdicts[0].startswith("Q or R too small: innovations are too large, NIS per dof ")
    assert wrong.whiteness is None and wrong.nees is None


def test_one_trial_needs_no_axis_and_lists_will_do():
    v, S, _, _ = kalman(9, trials=1, steps=30)
    one = report_metrics(consistency_report(v[0].tolist(), S[0].astype(np.float64)))
    assert one == report_metrics(consistency_report(v, S))
    columns = consistency_report(v[0, ..., None], S[0]), consistency_report(v[..., None], S)
    assert all(report_metrics(report) == one for report in columns)
    few = consistency_report([[0.3], [-0.1]], [[1.0]])
    assert few.consistent and few.nis.num_values == 2
    single = consistency_of_nis([1.0], 1)
    assert single.verdicts == ("consistent: NIS per dof 1.00 (1 expected, of a single step)",)


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"innovations": np.zeros(5)}, r"innovations is .* \(5,\), not \(..., m\)|has the shape"),
        ({"innovations": np.zeros((0, 2))}, "innovations has the shape"),
        ({"covariances": np.ones((5, 2))}, r"covariances is .* not \(2, 2\)"),
        ({"covariances": np.ones((4, 2, 2))}, r"covariances is .* not \(5, 2, 2\)"),
        ({"innovations": np.full((5, 2), np.nan)}, r"innovations\[0, 0\] is nan; .* by mask"),
        ({"covariances": np.full((2, 2), np.inf)}, r"covariances\[0, 0, 0\] is inf"),
        ({"covariances": np.diag([1.0, -2.0])}, r"covariances\[0\] is not positive .* -2; "),
        ({"covariances": np.array([[1.0, 0.5], [0.0, 1.0]])}, r"\[0\] is not symmetric"),
        ({"mask": np.ones(4, bool)}, r"mask is bool \(4,\), not bool \(5,\)"),
        ({"mask": np.ones(5)}, "mask is float64"),
        ({"mask": np.zeros(5, bool)}, "mask leaves nothing"),
        ({"errors": np.zeros((5, 3))}, "error_covariances is missing"),
        ({"error_covariances": np.eye(3)}, "errors is missing"),
        ({"errors": np.zeros((5, 3)), "error_covariances": np.zeros((3, 3))}, "not positive def"),
        ({"names": ["a"]}, r"names is \['a'\], not a name for each of 2"),
        ({"names": ["a", "a"]}, "two components have one name"),
        ({"error_mask": np.ones(5, bool)}, "errors is missing: error_mask is of them"),
        (
            {"innovations": np.full((5, 2), 1e200)},
            r"square of innovations\[0, 0\] is inf; leave it",
        ),
        ({"num_lags": 5}, "num_lags is 5, but the longest series has 5 values"),
        ({"num_lags": 0}, "num_lags is 0, not a whole number"),
    ],
)
def test_bad_arguments_are_named(wrong, problem):
    given = {"innovations": np.ones((5, 2)), "covariances": np.eye(2)}
    with pytest.raises(ValueError, match=problem) as refused:
        consistency_report(**(given | wrong))
    assert "\n" not in str(refused.value)


def test_the_covariance_that_is_not_positive_definite_is_named_by_its_step():
    S = np.tile(np.eye(2), (3, 7, 1, 1))
    S[1, 4] = [[1.0, 1.0], [1.0, 1.0]]
    with pytest.raises(ValueError, match=r"covariances\[1, 4\] is not positive definite"):
        consistency_report(np.ones((3, 7, 2)), S)
    mask = np.ones((3, 7), bool)
    mask[1, 4] = False
    assert consistency_report(np.ones((3, 7, 2)), S, mask=mask).nis.num_values == 20


def test_a_few_giant_innovations_do_not_hide_in_the_scatter_that_they_make():
    """Four headings of 200 are not wrapped: the mean of NIS is 300, and so is its own error."""
    v, S, _, _ = kalman(3, trials=1, steps=200)
    assert consistency_report(v, S).consistent
    turned = v.copy()
    turned[0, ::50, 1] += 2 * np.pi
    found = consistency_report(turned, S)
    assert str(found).splitlines() == list(found.verdicts)
    assert not found.consistent and abs(found.nis.score) < 3.0
    (verdict,) = (line for line in found.verdicts if "outliers" in line)
    worst = int(np.argmax(found.nis.values))
    assert verdict.startswith("4 of 200 steps are outliers: NIS is ")
    assert f"at step [{worst}], of 2 dof" in verdict and "not wrapped" in verdict


def test_innovations_of_right_filters_are_rarely_outliers():
    """One of 400 reports is expected to name one, at a probability of 0.27 %."""
    rng = np.random.default_rng(0)
    reports = [consistency_report(rng.normal(size=(50, 2)), np.eye(2)) for _ in range(300)]
    assert sum("outliers" in line for report in reports for line in report.verdicts) <= 4


def test_a_constant_innovation_is_a_bias_though_it_has_no_scatter():
    found = consistency_report(np.ones((200, 2)), np.eye(2))
    assert not found.consistent and found.verdicts[0].startswith("a bias: innovations have the mea")


def test_one_step_is_not_said_to_be_white():
    one = consistency_report([[0.3, -0.5]], np.eye(2))
    assert one.consistent and one.verdicts[0].endswith("too few to say whether they are white")


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"nis": np.ones((2, 2, 2))}, "nis has the shape"),
        ({"nis": np.array([1.0, -1.0, 1.0])}, r"nis\[1\] is -1.0, not a square"),
        ({"nis": np.array([1.0, np.nan, 1.0])}, r"nis\[1\] is nan"),
        ({"dof": np.array([1, 1])}, "dof is int64"),
        ({"dof": np.array([1.0, 1.0, 1.0])}, "dof is float64"),
        ({"dof": np.array([1, -1, 1])}, "dof holds -1"),
        ({"dof": 0}, "dof is 0 in all steps"),
        ({"nees": np.ones(3)}, "nees_dof is missing"),
        ({"nees_dof": 3}, "nees is missing"),
        ({"whitened": np.ones((2, 3))}, r"whitened is .* not \(3, m\)"),
        ({"whitened": np.full((3, 1), np.inf)}, "whitened holds infinite"),
    ],
)
def test_bad_squares_are_named(wrong, problem):
    with pytest.raises(ValueError, match=problem):
        consistency_of_nis(**({"nis": np.ones(3), "dof": 1} | wrong))
