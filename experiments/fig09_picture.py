"""Picture of the topological map of a room as it grows, as computed by `fig09_global`."""

from pathlib import Path

import numpy as np

from experiments.common import BLACK, BLUE, GREEN, PINK, RED, SKY, Numbers


def draw_walls(axis, numbers: Numbers) -> None:
    """Draw the walls and set the axis."""
    for x1, y1, x2, y2 in numbers["walls"]:
        axis.plot([x1, x2], [y1, y2], color="#8C8C8C", linewidth=1.3)
    axis.set(xlim=(-0.15, 6.15), ylim=(-0.15, 5.15), aspect="equal")


def draw_robot(axis, pose: list[float], size: float) -> None:
    """Draw the robot as an arrow of length `size` [m] along its heading."""
    x, y, heading = pose
    axis.arrow(
        x,
        y,
        size * np.cos(heading),
        size * np.sin(heading),
        color=RED,
        width=0.12 * size,
        head_width=0.55 * size,
        head_length=0.45 * size,
        length_includes_head=True,
        linewidth=0,
        zorder=4,
    )


def draw_map(axis, found: Numbers, width: float, size: float) -> None:
    """Draw nodes and arcs of a map."""
    for line, driven in zip(found["lines"], found["driven_only"], strict=True):
        label = "arc of the map, driven only" if driven else "arc of the map"
        dashes = (0, (3, 1.5)) if driven else "-"
        axis.plot(
            *np.array(line).T, color=GREEN, linewidth=width, linestyle=dashes, label=label, zorder=2
        )
    for line in found["frontiers"]:
        label = "open frontier"
        axis.plot(*np.array(line).T, color=PINK, linewidth=width / 2, label=label, zorder=1.5)
        axis.plot(*line[-1], "x", color=PINK, markersize=size, zorder=3)
    if found["xy"]:
        axis.plot(
            *np.array(found["xy"]).T,
            "o",
            color=GREEN,
            markersize=size,
            markeredgecolor="white",
            markeredgewidth=0.5,
            label="node of the map",
            zorder=3,
        )


def draw_step(axis, numbers: Numbers, t: int) -> None:
    """Draw the local diagram of scan `t` over the map it has been added to."""
    view, found = numbers["local"][t], numbers["maps"][t]
    draw_walls(axis, numbers)
    if view["branches"]:
        axis.plot(*np.array(view["branches"]).T, "s", color=SKY, markersize=1.1, zorder=1)
    draw_map(axis, found, 1.4, 5)
    if view["nodes"]:
        nodes = np.array(view["nodes"]).T
        axis.plot(*nodes, "o", markersize=8, markerfacecolor="none", color=BLACK, zorder=3)
    draw_robot(axis, numbers["estimates"][t], 0.6)
    counts = f"{numbers['nodes_in_map'][t]} nodes, {numbers['arcs_in_map'][t]} arcs"
    axis.set_title(f"scan {t + 1}: {counts}", fontsize=9)
    axis.tick_params(labelsize=7)


def draw_whole(axis, numbers: Numbers) -> None:
    """Draw the map at the end over the Voronoi graph of the full room."""
    draw_walls(axis, numbers)
    for line in numbers["reference"]["lines"]:
        axis.plot(
            *np.array(line).T, color=SKY, linewidth=5, alpha=0.6, label="branch of the full room"
        )
    near, ring = numbers["near_m"], np.linspace(0, 2 * np.pi, 40)
    label = f"{100 * near:.0f} cm around a junction of the full room"
    for junction in numbers["reference"]["junctions"]:
        rim = np.array(junction["xy"])[:, None] + near * np.array([np.cos(ring), np.sin(ring)])
        axis.plot(*rim, color=BLACK, linewidth=1.1, label=label)
    draw_map(axis, numbers["maps"][-1], 1.8, 6)
    path = np.array(numbers["places"])[:, :2].T
    axis.plot(*path, color=BLUE, linewidth=0.7, linestyle=":", label="path between the scan poses")
    for t, pose in enumerate(numbers["estimates"]):
        draw_robot(axis, pose, 0.28)
        axis.annotate(f"{t + 1}", pose[:2], (-9, -9), textcoords="offset points", fontsize=8)
    result = numbers["comparison"]
    axis.set_title(
        f"{result['nodes_found']} of {result['junctions']} junctions, "
        f"{result['arcs_found']} of {result['arcs']} arcs; spurious: "
        f"{len(result['nodes_spurious'])} nodes, {len(result['arcs_spurious'])} arcs"
    )
    axis.set(xlabel="x [m]", ylabel="y [m]")


def draw(numbers: Numbers, path: Path) -> None:
    """Draw the ten steps, and below them the map at the end."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 12.5), dpi=100, layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=[1, 1.45])
    steps = upper.subplots(2, 5, sharex=True, sharey=True)
    for t, axis in enumerate(steps.flat):
        draw_step(axis, numbers, t)
    for axis in steps.flat:
        axis.set(xlabel="x [m]", ylabel="y [m]")
        axis.label_outer()
    whole = lower.subplots()
    draw_whole(whole, numbers)
    handles, names = whole.get_legend_handles_labels()
    unique = dict(zip(names, handles, strict=True))
    lower.legend(unique.values(), unique.keys(), loc="outside right center", frameon=False)
    upper.suptitle(
        "light blue: branches of the local diagram; rings: its junctions; green: the map so far; "
        "arrow: the robot",
        fontsize=10,
    )
    figure.savefig(path)
