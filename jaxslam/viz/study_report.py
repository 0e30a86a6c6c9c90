"""The report of a study as one page of HTML, pictures inside, without scripts."""

import base64
import html
from collections.abc import Sequence
from io import BytesIO
from typing import Any

from matplotlib.figure import Figure

from jaxslam.core.types import Metrics

STYLE = """
body { font: 15px/1.45 sans-serif; max-width: 75em; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; font-size: 13px }
th, td { padding: 3px 10px; text-align: right; border-bottom: 1px solid #ddd; white-space: nowrap }
th:first-child, td:first-child { text-align: left; white-space: normal }
img { max-width: 100%; display: block; margin: 1em 0 }
div { overflow-x: auto }
"""


def study_html(
    title: str,
    numbers: Metrics,
    findings: Sequence[str],
    notes: Sequence[str],
    pictures: Sequence[tuple[str, Figure]],
) -> str:
    """The page.

    Args:
        title: Name of the study.
        numbers: As `study.report` makes them.
        findings: In words.
        notes: What was assumed.
        pictures: Each with its heading.
    """
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{html.escape(title)}</h1>",
        _listed(findings),
        "<h2>Variants</h2>",
        f"<div>{_table(numbers)}</div>",
    ]
    for heading, figure in pictures:
        parts += [f"<h2>{html.escape(heading)}</h2>", _image(heading, figure)]
    if notes:
        parts += ["<h2>Notes</h2>", _listed(notes)]
    about = (
        f"{numbers['trials']} trials of each variant, seed {numbers['seed']}; "
        f"{numbers['seconds']:.0f} s of computing; at most {numbers['peak_mb']:.0f} MB of memory."
    )
    parts += [f"<p>{html.escape(about)}</p>", "</body></html>"]
    return "\n".join(parts) + "\n"


def _listed(texts: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{html.escape(text)}</li>" for text in texts) + "</ul>"


def _image(heading: str, figure: Figure) -> str:
    with BytesIO() as buffer:
        figure.savefig(buffer, format="png")
        data = base64.b64encode(buffer.getvalue()).decode()
    return f'<img alt="{html.escape(heading)}" src="data:image/png;base64,{data}">'


def _table(numbers: Metrics) -> str:
    """A line for each variant."""
    rows = numbers["variants"]
    has_cost = all("cost" in row for row in rows)
    heads = ["variant", "success %", "[95 %]", *(["cost"] if has_cost else [])]
    heads += ["RMSE p50 m", "p90", "p99", "heading deg", "NEES", "median time to failure s"]
    heads += ["matches", "landmarks", "s a trial"]
    lines = ["<tr>" + "".join(f"<th>{head}</th>" for head in heads) + "</tr>"]
    for row in rows:
        own, rmse, nees = row["success"], row["position_rmse_m"], row["nees"]
        cells = [row["name"], f"{100 * own['value']:.1f}"]
        cells.append(f"{100 * own['low']:.1f} to {100 * own['high']:.1f}")
        cells += [f"{row['cost']:g}"] if has_cost else []
        cells += [_number(rmse[key]["value"]) for key in ("p50", "p90", "p99")]
        cells.append(_number(row["heading_rmse_deg"]))
        cells.append("" if nees is None else _number(nees["mean"]))
        cells.append(_median_time(row["time_to_failure_s"]))
        cells += [f"{row[key]:.1f}" for key in ("matches", "landmarks")]
        cells.append(f"{row['seconds_per_trial']:.2g}")
        lines.append("<tr>" + "".join(f"<td>{html.escape(x)}</td>" for x in cells) + "</tr>")
    return "<table>" + "\n".join(lines) + "</table>"


def _number(value: Any) -> str:
    return "infinite" if value is None else f"{value:.3g}"


def _median_time(survival: Metrics) -> str:
    """Time by which half of the trials have failed; empty where fewer have."""
    for time, share in zip(survival["times"], survival["share_without_failure"], strict=True):
        if share <= 0.5:
            return f"{time:.1f}"
    return ""
