"""What a study has found, in words; what is not significant is said so."""

import math
from typing import Any

from jaxslam.core.types import Metrics

LEVEL = 0.05  # of significance, adjusted to the number of comparisons
MAX_COMPARED = 12  # variants that are compared with the first in words
MAX_NAMED = 6  # of a list of variants
OVER_CONFIDENT, CAUTIOUS = 1.5, 0.67  # NEES per degree of freedom beyond which a filter is named


def findings(numbers: Metrics) -> list[str]:
    """Sentences on the numbers of `reporting.report`, the most important first."""
    rows = numbers["variants"]
    first = (
        f"{len(rows)} variant{'s' if len(rows) > 1 else ''} of {numbers['trials']} trials. "
        "A trial succeeds if its position is "
        f"never more than {numbers['success_m']:g} m off; [ ] are 95 % intervals."
    )
    if len(rows) == 1:
        return [first, f"{_named(rows[0])} succeeds in {_share(rows[0])} of the trials."]
    found = [first, *_best(numbers), *_cheapest(numbers)]
    found += [_effect(one) for one in numbers["effects"]]
    compared = [row for row in rows if "against_first" in row]
    if not numbers["effects"] and len(compared) <= MAX_COMPARED:
        found += [_against(row, rows[0]) for row in compared]
    return [*found, *_places(rows), *_honesty(rows), *_broken(rows)]


def _named(row: Metrics) -> str:
    return f'"{row["name"]}"'


def _percent(value: float) -> str:
    return f"{100.0 * value:.1f}"


def _interval(one: Any) -> str:
    return f"[{_percent(one['low'])}, {_percent(one['high'])}]"


def _share(row: Metrics) -> str:
    """Share of successes with its interval."""
    return f"{_percent(row['success']['value'])} % {_interval(row['success'])}"


def _failure(row: Metrics) -> str:
    """Share of failures with its interval."""
    own = row["success"]
    low, high = _percent(1.0 - own["high"]), _percent(1.0 - own["low"])
    return f"{_percent(1.0 - own['value'])} % [{low}, {high}]"


def _alike(numbers: Metrics) -> list[Metrics]:
    """Variants that do not succeed significantly less often than the best one; it is the first."""
    rows = numbers["variants"]
    others = [row for row in rows if "against_best" in row]
    alike = [row for row in others if row["against_best"]["success"]["adjusted_p_value"] >= LEVEL]
    return [rows[numbers["best"]], *alike]


def _best(numbers: Metrics) -> list[str]:
    rows = numbers["variants"]
    best, *alike = _alike(numbers)
    if len(alike) == len(rows) - 1:
        ends = sorted(row["success"]["value"] for row in rows)
        if ends[0] == ends[-1]:
            return [f"All variants succeed equally often: in {_share(best)} of the trials."]
        return [
            f"No variant succeeds significantly less often than {_named(best)}: all "
            f"{_percent(ends[0])} to {_percent(ends[-1])} %."
        ]
    text = f"{_named(best)} succeeds most often: {_share(best)}."
    if not alike:
        return [f"{text} All others succeed significantly less often."]
    shown = ", ".join(_named(row) for row in alike[:MAX_NAMED])
    more = f" and {len(alike) - MAX_NAMED} more" if len(alike) > MAX_NAMED else ""
    less = len(rows) - 1 - len(alike)
    return [
        f"{text} Not significantly less often: {shown}{more}. "
        f"{less} {'others do' if less > 1 else 'other does'}, significantly."
    ]


def _cheapest(numbers: Metrics) -> list[str]:
    alike = [row for row in _alike(numbers) if "cost" in row]
    if not alike:
        return []
    best = alike[0]
    least = min(alike, key=lambda row: row["cost"])
    if least is best or least["cost"] == best["cost"]:
        return [f"None that costs less than {_named(best)} ({best['cost']:g}) does as well."]
    return [
        f"{_named(least)} costs least, {least['cost']:g}, of those that are not significantly "
        f"worse than {_named(best)} ({best['cost']:g}): {_share(least)}."
    ]


def _effect(one: Metrics) -> str:
    """What a value of a setting changes, over variants that are equal in all others."""
    own = one["success"]
    change = f"{100.0 * own['mean']:+.1f} points {_interval(own)}"
    if _excludes(own["low"], own["high"], 0.0):
        text = f"trials succeed {'more' if own['mean'] > 0 else 'less'} often, by {change}"
    else:
        text = f"the difference in success is not significant, {change}"
    low, high = one["position_rmse_ratio_interval"]
    if _excludes(low, high, 1.0):
        text += f"; errors are {one['position_rmse_ratio']:.2f} times as large [{low:.2f}, "
        text += f"{high:.2f}]"
    return (
        f"{one['setting']} {_value(one['value'])} instead of {_value(one['reference'])}, over "
        f"{one['pairs_of_variants']} pairs of variants: {text}."
    )


def _excludes(low: float, high: float, value: float) -> bool:
    """Whether an interval, if there is one, lies on one side of a value."""
    return low > value or high < value


def _value(value: Any) -> str:
    if value is None:
        return "as by default"
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def _against(row: Metrics, first: Metrics) -> str:
    """How a variant differs from the first one."""
    own = row["against_first"]
    success, shares = own["success"], f"{_failure(row)} against {_failure(first)}"
    if success["adjusted_p_value"] < LEVEL:
        word = "less" if success["value"] > 0 else "more"
        text = f"{_named(row)} fails {word} often than {_named(first)}: {shares}"
        text += f", a difference of [{_percent(-success['high'])}, "
        text += f"{_percent(-success['low'])}] points"
    elif success["only_first"] or success["only_second"]:
        text = (
            f"Failures of {_named(row)} and {_named(first)} do not differ significantly: {shares}"
        )
    else:
        text = f"{_named(row)} fails in the same trials as {_named(first)}: {_failure(row)}"
    ratio, (low, high) = own["position_rmse_ratio"], own["position_rmse_ratio_interval"]
    if not math.isfinite(high - low):
        return text + "."
    if own["position_rmse_adjusted_p_value"] < LEVEL:
        return f"{text}; its errors are {ratio:.2f} times as large [{low:.2f}, {high:.2f}]."
    return f"{text}; their errors do not differ significantly, ratio [{low:.2f}, {high:.2f}]."


def _places(rows: list[Metrics]) -> list[str]:
    """Where the variant fails that fails most."""
    row = min(rows, key=lambda row: row["success"]["value"])
    places = row["places"]
    failures = {
        (i, j): count for i, line in enumerate(places["failures"]) for j, count in enumerate(line)
    }
    total, most = sum(failures.values()), max(failures, key=lambda at: failures[at])
    if failures[most] < 2:
        return []
    x, y = (o + places["cell_m"] * (k + 0.5) for o, k in zip(places["origin_m"], most, strict=True))
    return [
        f"{_named(row)} fails most often near x {x:.1f}, y {y:.1f} m: {failures[most]} of "
        f"{total} failures begin there."
    ]


def _honesty(rows: list[Metrics]) -> list[str]:
    """Variants whose filter says that it is more, or less, accurate than it is."""
    found = []
    for word, verb in (("over-confident", "below"), ("cautious", "above")):
        own = []
        for row in rows:
            nees = row["nees"]
            if nees is None or nees["standard_error"] is None:
                continue
            low, high = (nees["mean"] + k * nees["standard_error"] for k in (-2.0, 2.0))
            if low > OVER_CONFIDENT if verb == "below" else high < CAUTIOUS:
                own.append(f"{_named(row)} (NEES {nees['mean']:.2g})")
        if own:
            more = f" and {len(own) - MAX_NAMED} more" if len(own) > MAX_NAMED else ""
            shown = ", ".join(own[:MAX_NAMED])
            found.append(f"The filter is {word}, NEES 1 being honest, of {shown}{more}.")
    return found


def _broken(rows: list[Metrics]) -> list[str]:
    """Trials whose numbers are not finite."""
    count = sum(row["nonfinite"] for row in rows)
    return [f"{count} trials are not finite; they count as failures."] if count else []
