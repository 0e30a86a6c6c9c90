"""The numbers of a study: a row for each variant, and the effect of each setting."""

from collections.abc import Sequence

import numpy as np

from jaxslam.core.types import Metrics
from jaxslam.evaluation.trial_statistics import holm, mean_interval, paired_difference
from jaxslam.study.kept_trials import Collected
from jaxslam.study.outcomes import (
    Outcomes,
    compare,
    failed_at,
    failures_by_place,
    position_rmse,
    ratio_of,
    succeeded,
    summarise,
)
from jaxslam.study.runner import Variant

CELL = 0.5  # [m] side of the squares of the map of failures


def report(
    variants: Sequence[Variant], found: Sequence[Collected], *, seed: int, success_distance: float
) -> Metrics:
    """The numbers of a study, as study.json holds them.

    Args:
        variants: Of the study.
        found: Of each, by `runner.run_timed`.
        seed: Of all that is random.
        success_distance: [m] a trial succeeds if its position is never further off.
    """
    outcomes = [one.record for one in found]
    failures = [(~succeeded(own, success_distance)).sum() for own in outcomes]
    # Of those that succeed as often, the one with the smallest errors.
    errors = [float(np.median(position_rmse(own))) for own in outcomes]
    best = min(range(len(outcomes)), key=lambda k: (failures[k], errors[k]))
    rows = []
    for number, (variant, own) in enumerate(zip(variants, outcomes, strict=True)):
        row: Metrics = {"name": variant.name, "settings": dict(variant.settings)}
        if variant.cost is not None:
            row["cost"] = variant.cost
        row |= summarise(
            own, success_distance=success_distance, scan_period=variant.robot.scan_period
        )
        row["seconds_per_trial"] = found[number].seconds / len(own.finite)
        row["places"] = failures_by_place(own, success_distance=success_distance, cell=CELL)
        for key, other in (("against_first", 0), ("against_best", best)):
            if number != other:
                row[key] = compare(outcomes[other], own, success_distance=success_distance)
        rows.append(row)
    for key in ("against_first", "against_best"):
        _adjust([row[key] for row in rows if key in row])
    return {
        "trials": len(outcomes[0].finite),
        "seed": seed,
        "success_m": success_distance,
        "best": best,
        "variants": rows,
        "effects": effects(variants, outcomes, success_distance=success_distance),
        "seconds": sum(one.seconds for one in found),
        "peak_mb": max(one.peak_mb for one in found),
    }


def _adjust(comparisons: Sequence[Metrics]) -> None:
    """Adjust the p-values of comparisons to their number, in place."""
    success = holm([one["success"]["p_value"] for one in comparisons])
    rmse = holm([one["position_rmse_p_value"] for one in comparisons])
    for one, p_success, p_rmse in zip(comparisons, success, rmse, strict=True):
        one["success"]["adjusted_p_value"] = float(p_success)
        one["position_rmse_adjusted_p_value"] = float(p_rmse)


def effects(
    variants: Sequence[Variant], outcomes: Sequence[Outcomes], *, success_distance: float
) -> list[Metrics]:
    """What each value of a setting changes against its first value, all others being equal.

    Over all pairs of variants that differ in this setting alone: the mean of the pairs in each
    trial, and its mean and standard error over the trials. Settings with one such pair are left
    out: it is a line of the table itself.
    """
    found = []
    for name in dict.fromkeys(key for one in variants for key in one.settings):
        by_rest: dict[str, dict] = {}
        for number, one in enumerate(variants):
            rest = {key: x for key, x in one.settings.items() if key != name}
            by_rest.setdefault(repr(sorted(rest.items())), {})[one.settings.get(name)] = number
        values = list(dict.fromkeys(one.settings.get(name) for one in variants))
        for value in values[1:]:
            pairs = [
                (own[values[0]], own[value])
                for own in by_rest.values()
                if values[0] in own and value in own
            ]
            if len(pairs) > 1:
                effect = _effect(outcomes, pairs, success_distance)
                found.append({"setting": name, "reference": values[0], "value": value} | effect)
    return found


def _effect(
    outcomes: Sequence[Outcomes], pairs: Sequence[tuple[int, int]], success_distance: float
) -> Metrics:
    """Mean differences of the second variants of some pairs from the first ones."""
    ok = np.array([[succeeded(outcomes[k], success_distance) for k in pair] for pair in pairs])
    with np.errstate(divide="ignore"):
        rmse = np.array([[np.log(position_rmse(outcomes[k])) for k in pair] for pair in pairs])
    success = paired_difference(*ok.mean(axis=0, dtype=float))
    low, high = mean_interval(success.mean, success.standard_error, success.pairs)
    return {
        "pairs_of_variants": len(pairs),
        "success": success._asdict() | {"low": low, "high": high},
        **ratio_of(paired_difference(*rmse.mean(axis=0))),
    }


def table_of_trials(
    variants: Sequence[Variant], found: Sequence[Collected], *, success_distance: float
) -> str:
    """All trials as a table of comma-separated values, the same text for the same outcomes."""
    lines = [
        "variant,trial,success,failed_at_s,position_rmse_m,largest_m,heading_rmse_rad,"
        "nees,finite,matches,landmarks"
    ]
    for number, (variant, one) in enumerate(zip(variants, found, strict=True)):
        own = one.record
        rmse, largest = position_rmse(own), own.error.max(axis=1)
        first, scans = failed_at(own, success_distance), own.error.shape[1]
        for trial in range(len(own.finite)):
            failed = first[trial] < scans
            time = f"{first[trial] * variant.robot.scan_period:.9g}" if failed else ""
            numbers = rmse[trial], largest[trial], own.heading_rmse[trial], own.nees[trial]
            text = ",".join(f"{x:.9g}" for x in numbers)
            lines.append(
                f"{number},{trial},{int(not failed)},{time},{text},{int(own.finite[trial])},"
                f"{own.matches[trial]:.9g},{own.landmarks[trial]}"
            )
    return "\n".join(lines) + "\n"
