"""The report that `jaxslam tune` ends with: its blocks of `metrics.json`, and `report.png`."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from jaxslam.core.types import Metrics
from jaxslam.evaluation import ConsistencyReport, report_metrics
from jaxslam.io import noise_file
from jaxslam.tuning import parameters, transforms
from jaxslam.tuning.standard_errors import StandardErrors
from jaxslam.tuning.tune_state import TuneResult

if TYPE_CHECKING:
    from jaxslam.viz.parameter_charts import Estimate

UNITS = {
    "odometry[0]": "m/\N{SQUARE ROOT}m",
    "odometry[1]": "m/\N{SQUARE ROOT}rad",
    "odometry[2]": "rad/\N{SQUARE ROOT}m",
    "odometry[3]": "rad/\N{SQUARE ROOT}rad",
    "range": "m",
    "bearing": "rad",
    "wall": "rad",
}
"""Units of the noise parameters, by their keys; the others have none."""

ERRORS = (
    ("loss", "loss"),
    ("position_rmse_m", "position RMSE [m]"),
    ("heading_rmse_deg", "heading RMSE [deg]"),
    ("nees", "NEES per dof"),
    ("diverged", "diverged episodes"),
)
"""Keys of `metrics.json`, before and after, with their names in tables."""


class TuneReport(NamedTuple):
    """What the report is made of.

    Attributes:
        before: Consistency of the filter before, on the episodes that it is evaluated on; None if
            no feature updated it.
        after: Consistency after.
        start: The parameters before.
        found: The parameters after, with the same tree.
        frozen: (P,) bool, not tuned.
        errors: Standard errors; None with fewer than two episodes.
    """

    before: ConsistencyReport | None
    after: ConsistencyReport | None
    start: Any
    found: Any
    frozen: np.ndarray
    errors: StandardErrors | None


def report_blocks(report: TuneReport) -> Metrics:
    """The blocks "consistency", "parameters" and "correlations" of `metrics.json`."""
    consistency = {
        when: None if found is None else report_metrics(found)
        for when, found in (("before", report.before), ("after", report.after))
    }
    estimates = estimates_of(report)
    parameters = {
        each.name: {
            "before": each.before,
            "value": each.after,
            "interval": None if np.isnan(each.interval[0]) else list(each.interval),
            "identifiable": each.identifiable,
            "frozen": each.frozen,
        }
        for each in estimates
    }
    matrix = correlation_of(report)
    tuned = [each.name for each in estimates if not each.frozen]
    correlations = None if matrix is None else {"names": tuned, "matrix": matrix.tolist()}
    return {"consistency": consistency, "parameters": parameters, "correlations": correlations}


def estimates_of(report: TuneReport) -> "list[Estimate]":
    """All P parameters, as `viz.parameter_charts` takes them.

    Positive ones have standard errors of their logarithms. The elements of a matrix are those of
    its unconstrained Cholesky factor.
    """
    from jaxslam.viz.parameter_charts import Estimate  # here, because matplotlib is slow to import

    names, errors = parameters.param_names(report.found), report.errors
    theta = [parameters.flatten_params(each) for each in (report.start, report.found)]
    values, std_errors = [np.array(x) for x in theta], np.full(len(names), np.nan)
    positive = np.zeros(len(names), bool)
    if errors is not None:
        std_errors = np.array(errors.relative)
    first = 0
    leaves = [jax.tree.leaves(tree) for tree in (report.start, report.found)]
    own_errors = [] if errors is None else jax.tree.leaves(errors.of_params)
    for k, transform in enumerate(transforms.of_leaves(report.found)):
        shape = np.shape(leaves[1][k])
        is_factor = transform.is_of_matrix
        count = shape[0] * (shape[0] + 1) // 2 if is_factor else math.prod(shape)
        own = slice(first, first + count)
        first += count
        if is_factor:
            continue
        for value, tree in zip(values, leaves, strict=True):
            value[own] = np.ravel(np.asarray(tree[k], np.float64))
        positive[own] = transform.forward is transforms.POSITIVE.forward
        if own_errors and not positive[own].all():
            std_errors[own] = np.ravel(np.asarray(own_errors[k], np.float64))
    sure = np.ones(len(names), bool) if errors is None else errors.identifiable | report.frozen
    return [
        Estimate(
            name=noise_file.key_of(name),
            before=float(values[0][k]),
            after=float(values[1][k]),
            std_error=float(std_errors[k]),
            positive=bool(positive[k]),
            frozen=bool(report.frozen[k]),
            identifiable=bool(sure[k]),
            unit=UNITS.get(noise_file.key_of(name), ""),
        )
        for k, name in enumerate(names)
    ]


def correlation_of(report: TuneReport) -> np.ndarray | None:
    """Correlations (F, F) of the estimates of the parameters that were tuned.

    Those of one whose standard error is not known are NaN; None without standard errors.
    """
    if report.errors is None:
        return None
    free = ~report.frozen
    covariance = report.errors.covariance[np.ix_(free, free)]
    relative = report.errors.relative[free]
    known = np.isfinite(relative) & (np.diagonal(covariance) > 0.0)
    std = np.where(known, np.sqrt(np.where(known, np.diagonal(covariance), 1.0)), np.nan)
    return covariance / np.outer(std, std)


def draw_report(
    path: Path, title: str, numbers: Metrics, found: TuneResult, report: TuneReport
) -> None:
    """Draw `report.png`."""
    from jaxslam.viz import canvas
    from jaxslam.viz.tuning_page import TuningPage, tuning_page

    before = numbers["before"]
    rows = [(name, before.get(key), numbers.get(key)) for key, name in ERRORS]
    page = TuningPage(
        title=f"Tuning of Q and R: {title}",
        subtitle=f"{numbers['evaluations']} evaluations; evaluated on {numbers['judged_on']}",
        before=report.before,
        after=report.after,
        estimates=estimates_of(report),
        correlation=correlation_of(report),
        training=found.loss,
        heldout=found.heldout,
        best=found.best,
        errors=[row for row in rows if row[1] is not None and row[2] is not None],
        notes=numbers["warnings"],
        series="corrections of the pose by the features",
    )
    canvas.save(tuning_page(page), path)
