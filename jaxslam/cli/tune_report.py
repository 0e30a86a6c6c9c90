"""The report that `jaxslam tune` ends with: its blocks of `metrics.json`, and `report.png`."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxslam.core.types import Metrics
from jaxslam.evaluation import ConsistencyReport, report_metrics
from jaxslam.io import noise_file
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
        names: (P,) keys of the parameters, one for each number.
        start: (P,) the parameters before.
        found: (P,) the parameters after.
        frozen: (P,) bool, not tuned.
        errors: Standard errors; None with fewer than two episodes.
    """

    before: ConsistencyReport | None
    after: ConsistencyReport | None
    names: tuple[str, ...]
    start: np.ndarray
    found: np.ndarray
    frozen: np.ndarray
    errors: StandardErrors | None


def report_blocks(report: TuneReport) -> Metrics:
    """The blocks "consistency", "parameters" and "correlations" of `metrics.json`."""
    consistency = {
        when: None if found is None else report_metrics(found)
        for when, found in (("before", report.before), ("after", report.after))
    }
    estimates = _estimates(report)
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


def _estimates(report: TuneReport) -> "list[Estimate]":
    """The parameters as `viz.parameter_charts` takes them."""
    from jaxslam.viz.parameter_charts import Estimate  # here, because matplotlib is slow to import

    errors, size = report.errors, len(report.names)
    relative = np.full(size, np.nan) if errors is None else errors.relative
    sure = np.ones(size, bool) if errors is None else errors.identifiable | report.frozen
    return [
        Estimate(
            name=name,
            before=float(report.start[k]),
            after=float(report.found[k]),
            std_error=float(relative[k]),
            frozen=bool(report.frozen[k]),
            identifiable=bool(sure[k]),
            unit=UNITS.get(name, ""),
        )
        for k, name in enumerate(report.names)
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
        title=title,
        subtitle=f"{numbers['evaluations']} evaluations; evaluated on {numbers['judged_on']}",
        before=report.before,
        after=report.after,
        estimates=_estimates(report),
        correlation=correlation_of(report),
        training=found.loss,
        heldout=found.heldout,
        best=found.best,
        errors=[row for row in rows if row[1] is not None and row[2] is not None],
        notes=numbers["warnings"],
    )
    canvas.save(tuning_page(page), path)


def numbers_of(params: NamedTuple) -> tuple[tuple[str, ...], np.ndarray]:
    """Keys (P,) and values (P,) float64 of all numbers of noise parameters."""
    names, values = [], []
    for key, value in noise_file.to_keys(params).items():
        if value is not None:
            array = np.asarray(value, np.float64)
            names += [key] if array.ndim == 0 else [f"{key}[{i}]" for i in range(array.size)]
            values += array.ravel().tolist()
    return tuple(names), np.array(values)
