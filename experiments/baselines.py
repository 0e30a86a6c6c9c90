"""Baselines and ablation of landmark types: four localisation methods on the same trials.

Dead reckoning by the encoders; the paper's filter, whose landmarks are Voronoi nodes alone, with
edge codes (the paper's) and with wall segments as labels; and all landmarks: nodes, corners and
wall directions. All have the same drives with the same encoder and range noise. Beside them,
without a robot, is the automaton on the complete global grid (`global_grid`): its time, and how
many of its junctions agree with those of the exact Voronoi diagram.
"""

from pathlib import Path

import jax

from experiments import common, global_grid
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.types import JUNCTION
from jaxslam.evaluation import summary
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.pipeline.config import Config

NODES = FilterConfig(landmark_kinds=(JUNCTION,))
CONFIGS = {  # by the name of the row in the JSON file
    "nodes_codes": Config(frontend=FrontendConfig(labels="codes"), filter=NODES),
    "nodes_runs": Config(filter=NODES),
    "all": Config(),
}
TITLES = {
    "dead_reckoning": "dead reckoning",
    "nodes_codes": "nodes, codes",
    "nodes_runs": "nodes, segments",
    "all": "all landmarks",
    global_grid.NAME: "global grid",
}
KEYS = ("position_rmse_m", "heading_rmse_deg", "nees", "diverged", "runs")


def compute(seed: int, num_trials: int) -> common.Numbers:
    """Errors of every baseline over the same trials, and the row of the global grid."""
    rows = []
    params = NoiseParams.for_simulated_robot()
    for name, config in CONFIGS.items():
        results = common.filter_trials(jax.random.key(seed), config, params, num_trials)
        found = summary.evaluate(results)
        rows.append({"name": name} | {key: found[key] for key in KEYS})
        wheels = found["dead_reckoning"] | {"nees": None, "runs": num_trials}
    rows = [{"name": "dead_reckoning"} | wheels, *rows, global_grid.compute(seed)]
    return {"seed": seed, "rows": rows}


def draw(numbers: common.Numbers, path: Path) -> None:
    """Bars of position and heading error, and of the time of diagrams."""
    *rows, grid = numbers["rows"]
    figure, axes = common.canvas(12, 3.2, 1, 3, widths=[4, 4, 3])
    colours = (common.BLACK, common.ORANGE, common.SKY, common.GREEN)
    names = [TITLES[row["name"]].replace(" ", "\n", 1) for row in rows]
    for axis, key, label in zip(
        axes[0, :2],
        ("position_rmse_m", "heading_rmse_deg"),
        ("position RMSE [m]", "heading RMSE [deg]"),
        strict=True,
    ):
        bars = axis.bar(names, [row[key] for row in rows], color=colours)
        axis.bar_label(bars, fmt="%.3g")
        axis.set(ylabel=label, yscale="log")
        axis.margins(y=0.25)
    axis = axes[0, 2]
    times = [1e3 * grid["seconds_per_grid"], 1e3 * grid["seconds_of_local_diagrams"]]
    titles = ["complete\nglobal grid", f"local diagrams\nof {grid['scans']} scans"]
    axis.bar_label(axis.bar(titles, times, color=(common.PINK, common.ORANGE)), fmt="%.3g")
    axis.set(ylabel="time of the automaton [ms]")
    axis.set_title(agreement(grid), fontsize=9)
    axis.margins(y=0.25)
    figure.savefig(path)


def agreement(grid: common.Numbers) -> str:
    """How the junctions of the global grid agree with the exact ones."""
    return (
        f"global grid: {grid['true_junctions_found']} of {grid['true_junctions']} junctions\n"
        f"found; {grid['junctions_correct']} of its {grid['junctions']} correct"
    )


def main(argv: list[str] | None = None) -> None:
    """Run the experiment, and print its table."""
    args = common.parse(__doc__, argv, runs=100)
    use_cpu_devices()
    numbers = compute(args.seed, args.runs)
    common.save(args.out, "baselines", numbers, draw)
    *rows, grid = numbers["rows"]
    print(f"{'':16}position    heading  NEES per dof  diverged")
    for row in rows:
        nees = "-" if row["nees"] is None else f"{row['nees']:.2f}"
        errors = f"{row['position_rmse_m']:6.3f} m {row['heading_rmse_deg']:6.2f} deg"
        print(f"{TITLES[row['name']]:16}{errors}{nees:>14}{row['diverged']:10d}")
    print(
        f"{TITLES[grid['name']]:16}       -          -             -         -"
        f"   {1e3 * grid['seconds_per_grid']:.0f} ms per grid of"
        f" {' x '.join(map(str, grid['cells']))} cells; local diagrams of {grid['scans']} scans"
        f" {1e3 * grid['seconds_of_local_diagrams']:.0f} ms"
    )
    print(agreement(grid).replace("\n", " "))


if __name__ == "__main__":
    main()
