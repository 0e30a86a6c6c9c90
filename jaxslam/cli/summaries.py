"""Printed summaries of results."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.core.types import Metrics
from jaxslam.io import noise_file

SUMMARY_ROWS = (
    ("position_rmse_m", "position RMSE", "m"),
    ("heading_rmse_deg", "heading RMSE", "deg"),
    ("ate_rmse_m", "ATE RMSE", "m"),
    ("rpe_translation_rmse_m", "RPE translation (delta 1 m)", "m"),
    ("rpe_rotation_rmse_deg", "RPE rotation (delta 1 m)", "deg"),
    ("translation_mean_m", "relation error, translation", "m"),
    ("rotation_mean_deg", "relation error, rotation", "deg"),
)
MAX_WARNINGS = 5  # that are printed
MAX_VERDICTS = 3


def print_summary(numbers: Metrics, title: str, out: Path) -> None:
    """Print a summary of the `metrics.json` of a run or of Monte-Carlo trials."""
    print(f"\n{title}; path length {numbers['path_length_m']:.0f} m")
    if numbers.get("skipped_lines"):
        print(f"{numbers['skipped_lines']} broken lines, or scans without odometry, skipped")
    for note in numbers.get("mended", ()):
        print(f"note: {note}")
    odometry = numbers.get("dead_reckoning", {})
    if odometry:
        print(f"{'':36}{'SLAM':>10}{'odometry':>10}{'ratio':>8}")
    _print_errors(numbers | numbers.get("relations", {}), odometry | odometry.get("relations", {}))
    for drive in numbers.get("drives", ()):
        print(f"  {drive['log']}: {drive['scans']} scans, {drive['path_length_m']:.0f} m")
        _print_errors(drive | drive.get("relations", {}), {})
    if "diverged" in numbers:
        print(f"  {'diverged trials':34}{numbers['diverged']:10d}{odometry['diverged']:10d}")
    if numbers.get("nees") is not None:
        print(f"  {'NEES per dof (1 if consistent)':34}{numbers['nees']:10.3f}")
    print(f"  {'landmarks':34}{numbers['landmarks']:10.0f}")
    print(f"  {'updates per scan':34}{numbers['matches']:10.1f}")
    if numbers.get("closures"):
        print(f"  {'loop closures':34}{numbers['closures']:10d}")
    consistency = numbers.get("map_consistency")
    if consistency is not None:
        _print_consistency(consistency)
    _print_seconds(numbers)
    if consistency is not None:
        _print_warnings(consistency["warnings"])
    print(f"results: {out}{os.sep}metrics.json, path.png, errors.png, map.geojson, ...")


def print_localisation(numbers: Metrics, title: str, out: Path) -> None:
    """Print a summary of the `metrics.json` of a localisation."""
    print(f"\n{title}; path length {numbers['path_length_m']:.0f} m")
    for note in numbers["mended"]:
        print(f"note: {note}")
    _print_errors(numbers, {})
    after = numbers["found_after_m"]
    print(f"  {'found after [m]':34}{'never' if after is None else f'{after:.1f}':>10}")
    print(f"  {'scans with probability above 0.9':34}{numbers['sure']:10.1%}")
    print(f"  {'searches of the map':34}{numbers['searches']:10d}")
    _print_seconds(numbers)
    print(f"results: {out}{os.sep}metrics.json, quality.csv, trajectory.tum, localised.png")


def _print_consistency(consistency: Metrics) -> None:
    """Print the share of scans that the map explains, and how far walls of two visits are apart."""
    walls = consistency["walls_median_m"]
    distance = "" if walls is None else f"{walls:10.3f}"
    explained = consistency["explained"]
    share = f"{'-':>10}" if explained is None else f"{explained:10.1%}"
    print(f"  {'explained scans, wall offset [m]':34}{share}{distance}")


def _print_warnings(warnings: Sequence[Metrics]) -> None:
    """Print where the map contradicts itself."""
    for warning in warnings[:MAX_WARNINGS]:
        print(f"WARNING: {warning['reason']}")
    if len(warnings) > MAX_WARNINGS:
        print(f"WARNING: {len(warnings) - MAX_WARNINGS} more parts are listed in metrics.json")


def _print_errors(slam_errors: Metrics, odometry_errors: Metrics) -> None:
    """Print the `SUMMARY_ROWS` that there are: errors of SLAM, of dead reckoning, their ratio."""
    for key, name, unit in SUMMARY_ROWS:
        error = slam_errors.get(key)
        if error is None:
            continue
        line = f"  {f'{name} [{unit}]':34}{error:10.3f}"
        if key in odometry_errors:
            ratio = odometry_errors[key] / error if error else np.inf
            line += f"{odometry_errors[key]:10.3f}{ratio:8.1f}"
        print(line)


def print_map_summary(numbers: Metrics, title: str, out: Path) -> None:
    """Print a summary of the `metrics.json` of a topological map."""
    print(f"\n{title}")
    print(f"  {'nodes, dead ends':34}{numbers['nodes']:10d}{numbers['dead_ends']:10d}")
    print(f"  {'arcs, independent cycles':34}{numbers['arcs']:10d}{numbers['rings']:10d}")
    print(f"  {'total arc length [m]':34}{numbers['length_m']:10.1f}")
    if numbers["arcs"]:
        print(f"  {'smallest clearance [m]':34}{numbers['narrowest_m']:10.2f}")
    print(f"  {'rooms, doors':34}{numbers['rooms']:10d}{numbers['doors']:10d}")
    areas = f"{numbers['reached_m2']:10.1f}{numbers['left_out_m2']:10.1f}"
    print(f"  {'reachable, omitted area [m^2]':34}{areas}")
    print(f"  {'run time [s]':34}{numbers['seconds']['run']:10.1f}")
    print(f"results: {out}{os.sep}metrics.json, map.png, map.geojson, rooms.json, ...")


def print_route_summary(numbers: Metrics, title: str, legs: Sequence[str], out: Path) -> None:
    """Print the legs of a route and a summary of its `metrics.json`."""
    print(f"\n{title}")
    for number, leg in enumerate(legs, start=1):
        print(f"  {number}. {leg}")
    lengths = f"{numbers['length_m']:10.1f}{numbers['straight_m']:10.1f}"
    print(f"  {'length, straight line [m]':34}{lengths}")
    narrowest = numbers["narrowest_m"]
    text = f"{narrowest:10.2f}" if np.isfinite(narrowest) else f"{'not known':>10}"
    print(f"  {'smallest clearance [m]':34}{text}")
    print(f"results: {out}{os.sep}route.json, route.png, metrics.json")


def _print_seconds(numbers: Metrics) -> None:
    seconds = numbers["seconds"]
    print(f"  {'run time, compile time [s]':34}{seconds['run']:10.1f}{seconds['compile']:10.1f}")


def print_tuning_summary(numbers: Metrics, title: str, out: Path) -> None:
    """Print a summary of the `metrics.json` of a tuning."""
    before = numbers["before"]
    print(f"\n{title}; {numbers['evaluations']} evaluations, evaluated on {numbers['judged_on']}")
    print(f"  {'':34}{'before':>12}{'after':>12}")
    rows = {"loss": "loss", "position_rmse_m": "position RMSE [m]", "nees": "NEES per dof"}
    rows |= {"heading_rmse_deg": "heading RMSE [deg]", "diverged": "diverged episodes"}
    for key, name in rows.items():
        if numbers.get(key) is not None and before.get(key) is not None:
            print(f"  {name:34}{before[key]:12.4g}{numbers[key]:12.4g}")
    _print_params(before["noise"], numbers["noise"], numbers["standard_errors"] or {})
    for warning in numbers["warnings"]:
        print(f"warning: {warning}")
    consistency = numbers["consistency"]["after"]
    if consistency is not None:
        for verdict in consistency["verdicts"][:MAX_VERDICTS]:
            print(f"filter: {verdict}")
    _print_seconds(numbers)
    print(f"results: {out}{os.sep}noise.json, metrics.json, report.png, history.png")


def _print_params(
    before: Mapping[str, Any], after: Mapping[str, Any], standard_errors: Mapping[str, float]
) -> None:
    """Print the noise parameters before and after a tuning, with relative standard errors.

    Args:
        before: Numbers or arrays by their keys in `metrics.json`; None where there is none.
        after: Likewise.
        standard_errors: By key; of an array, with an index.
    """
    if standard_errors:
        print(f"  {'noise parameters (Q and R)':34}{'':24}{'standard error':>18}")
    for key, value in after.items():
        if value is None:
            continue
        pairs = zip(np.ravel(before[key]), np.ravel(value), strict=True)
        for index, (old, new) in enumerate(pairs):
            number = f"{key}[{index}]" if np.ndim(value) else key
            error = standard_errors.get(number, np.nan)
            text = "" if np.isnan(error) else "unknown" if np.isinf(error) else f"{error:.0%}"
            name = noise_file.name_of(number)
            print(f"  {name:34}{old:12.4g}{new:12.4g}{text:>18}".rstrip())
