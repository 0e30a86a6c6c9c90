"""Numbers and words of a study, of outcomes that are made up."""

import csv
import io
import json

import numpy as np
import pytest

from jaxslam.evaluation.trial_statistics import holm
from jaxslam.io.output import plain
from jaxslam.simulation import Robot
from jaxslam.study.kept_trials import Collected
from jaxslam.study.outcomes import Outcomes
from jaxslam.study.reporting import effects, report, table_of_trials
from jaxslam.study.runner import Variant
from jaxslam.study.wording import findings

N, T = 200, 8


def variant(name, cost=None, **settings):
    return Variant(name, settings, None, None, Robot(scan_period=0.5), None, None, T, None, cost)


def outcomes(failures, scale=1.0, nees=1.0, seed=0):
    """Trials with errors of about 0.1 m times `scale`; the first `failures` are 2 m off."""
    error = 0.1 * scale * np.random.default_rng(seed).uniform(0.5, 1.0, (N, T))
    error[:failures, 5:] = 2.0
    place = np.zeros((N, T, 2), np.float32)
    place[..., 0] = np.arange(T)
    own = np.random.default_rng(1).normal(nees, 0.1, N)
    count = np.full(N, 3)
    return Outcomes(error.astype(np.float32), place, np.ones(N), own, count > 0, count, count)


def reported(variants, found):
    timed = [Collected(one, 2.0, 500.0) for one in found]
    return report(variants, timed, seed=3, success_distance=0.5)


def test_a_significant_difference_is_said_with_its_intervals():
    numbers = reported([variant("A"), variant("B")], [outcomes(40), outcomes(4, 0.5)])
    said = findings(numbers)
    assert numbers["best"] == 1 and numbers["variants"][1]["seconds_per_trial"] == 0.01
    assert '"B" succeeds most often: 98.0 % [95.0, 99.2]. All others succeed' in said[1]
    assert '"B" fails less often than "A": 2.0 % [0.8, 5.0] against 20.0 % [15.0, 26.1]' in said[2]
    assert "its errors are 0.3" in said[2] and "times as large" in said[2]
    assert '"A" fails most often near x 5.2, y 0.2 m: 40 of 40 failures begin there.' in said
    json.dumps(plain(numbers), allow_nan=False)


def test_a_difference_that_is_not_significant_is_said_so():
    other = outcomes(4, seed=5)
    shifted = other._replace(error=np.roll(other.error, 2, axis=0))
    numbers = reported([variant("A"), variant("B")], [outcomes(4), shifted])
    said = findings(numbers)
    assert 'No variant succeeds significantly less often than "A": all 98.0 to 98.0 %' in said[
        1
    ] or ("All variants succeed equally often" in said[1])
    assert 'Failures of "B" and "A" do not differ significantly: 2.0 %' in said[2]
    assert "their errors do not differ significantly, ratio [" in said[2]
    same = findings(reported([variant("A"), variant("B")], [outcomes(4), outcomes(4, 1.01)]))
    assert '"B" fails in the same trials as "A": 2.0 %' in same[2]


def test_the_cheapest_of_the_good_ones_is_named():
    variants = [variant("dear", 90.0), variant("cheap", 40.0), variant("bad", 10.0)]
    numbers = reported(variants, [outcomes(2), outcomes(3), outcomes(60)])
    (text,) = (text for text in findings(numbers) if "costs" in text)
    assert text.startswith('"cheap" costs least, 40, of those that are not significantly worse')
    alone = reported(variants[:2], [outcomes(2), outcomes(60)])
    assert 'None that costs less than "dear" (90) does as well.' in findings(alone)


def test_filters_that_are_not_honest_are_named():
    found = [outcomes(0), outcomes(0, nees=3.0), outcomes(0, nees=0.2)]
    said = findings(reported([variant(x) for x in "ABC"], found))
    assert 'The filter is over-confident, NEES 1 being honest, of "B" (NEES 3).' in said
    assert 'The filter is cautious, NEES 1 being honest, of "C" (NEES 0.19).' in said


def test_effects_are_those_over_pairs_that_differ_in_one_setting_alone():
    variants, found = [], []
    for scanner, fewer in (("a", 0), ("b", 20)):
        for people, more in ((0, 10), (5, 50)):
            variants.append(variant(f"{scanner}{people}", scanner=scanner, people=people))
            found.append(outcomes(30 + more - fewer))
    (one, two) = effects(variants, found, success_distance=0.5)
    assert (one["setting"], one["reference"], one["value"]) == ("scanner", "a", "b")
    assert one["pairs_of_variants"] == 2 and np.isclose(one["success"]["mean"], 20 / N)
    assert np.isclose(two["success"]["mean"], -40 / N)
    said = findings(reported(variants, found))
    assert any(
        "scanner b instead of a, over 2 pairs of variants: trials succeed more" in x for x in said
    )
    # By hand: a trial succeeds more often in both pairs, in one, or in none.
    gap = np.zeros(N)
    gap[20:40] += 0.5
    gap[60:80] += 0.5
    np.testing.assert_allclose(one["success"]["standard_error"], gap.std(ddof=1) / np.sqrt(N))
    assert effects(variants[:2], found[:2], success_distance=0.5) == []


def test_one_trial_says_nothing_about_differences():
    first, second = (Outcomes(*(x[:1] for x in outcomes(k))) for k in (0, 1))
    variants = [variant("a0", s="a", p=0), variant("a5", s="a", p=5)]
    variants += [variant("b0", s="b", p=0), variant("b5", s="b", p=5)]
    said = findings(reported(variants, [first, second, second, first]))
    assert sum("the difference in success is not significant" in text for text in said) == 2
    assert not any("more often" in text or "less often, by" in text for text in said)
    said = findings(reported(variants[:2], [first, second]))
    assert 'Failures of "a5" and "a0" do not differ significantly' in said[2]
    json.dumps(plain(reported(variants, [first] * 4)), allow_nan=False)


def test_every_trial_is_a_line_of_the_table():
    found = [Collected(outcomes(3), 1.0, 1.0), Collected(outcomes(0), 1.0, 1.0)]
    text = table_of_trials([variant("A"), variant("B")], found, success_distance=0.5)
    rows = list(csv.DictReader(io.StringIO(text)))
    assert len(rows) == 2 * N and [row["success"] for row in rows[:4]] == ["0", "0", "0", "1"]
    assert rows[0]["failed_at_s"] == "2.5" and rows[3]["failed_at_s"] == ""
    assert float(rows[0]["largest_m"]) == 2.0 and rows[N]["variant"] == "1"


def test_adjusted_p_values_are_those_of_holm():
    """Of 0.01, 0.04, 0.03: times 3, then 2, then 1, never falling."""
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
    np.testing.assert_allclose(holm([0.9, 0.8]), [1.0, 1.0])


@pytest.mark.parametrize("count", [1, 3])
def test_the_page_is_one_file_without_scripts(count):
    from jaxslam.viz import study_page, study_report

    variants = [variant(f"<{k}>", 10.0 * k) for k in range(count)]
    numbers = reported(variants, [outcomes(5 * k) for k in range(count)])
    walls = [np.array([[0.0, -1.0, 8.0, -1.0]])] * count
    page = study_page.StudyPage(numbers["variants"], walls, 0, 4.0)
    pictures = [("all", study_page.study_page(page))]
    pictures.append(("cost", study_page.cost_picture(numbers["variants"])))
    pictures.append(("maps", study_page.maps_picture(page, range(count))))
    text = study_report.study_html("S", numbers, findings(numbers), ["a & b"], pictures)
    assert text.count("data:image/png;base64,") == 3 and "<script" not in text
    assert "&lt;0&gt;" in text and "<0>" not in text and "a &amp; b" in text
    assert text.count("<tr>") == 1 + count and "http" not in text


def test_the_front_of_costs_is_what_nothing_beats_for_less():
    from jaxslam.viz.study_page import pareto_front

    cost, value = np.array([10.0, 5.0, 7.0, 5.0]), np.array([0.9, 0.5, 0.4, 0.6])
    assert pareto_front(cost, value).tolist() == [3, 0]
