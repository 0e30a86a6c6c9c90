"""What each kind of landmark is worth: the same runs, localised in four ways.

Dead reckoning by the encoders; the paper's filter, whose landmarks are Voronoi nodes alone, with
its edge codes and with straight runs as labels; and all landmarks: nodes, corners and the
directions of walls. All see the same drives with the same encoder and range noise.
"""

from pathlib import Path

import jax

from experiments import common
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.types import JUNCTION
from jaxslam.evaluation import summary
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.pipeline.config import Config

ROWS = {
    "nodes_codes": Config(
        frontend=FrontendConfig(
            labels="codes",
        ),
        filter=FilterConfig(
            landmark_kinds=(JUNCTION,),
        ),
    ),
    "nodes_runs": Config(
        filter=FilterConfig(
            landmark_kinds=(JUNCTION,),
        ),
    ),
    "all": Config(),
}
KEPT = ("position_rmse_m", "heading_rmse_deg", "nees", "diverged", "runs")


def compute(seed: int, runs: int) -> common.Numbers:
    """Errors of every baseline over the same runs."""
    rows = []
    for name, config in ROWS.items():
        tracks = common.many(jax.random.key(seed), config, NoiseParams.for_simulated_robot(), runs)
        found = summary.evaluate(tracks)
        rows.append({"name": name} | {key: found[key] for key in KEPT})
        blind = found["dead_reckoning"] | {"nees": None, "runs": runs}
    return {"seed": seed, "rows": [{"name": "dead_reckoning"} | blind, *rows]}


def draw(numbers: common.Numbers, path: Path) -> None:
    """Bars of position and heading error."""
    rows = numbers["rows"]
    figure, axes = common.canvas(9, 3, 1, 2)
    colours = (common.BLACK, common.ORANGE, common.SKY, common.GREEN)
    names = [row["name"].replace("_", "\n") for row in rows]
    for axis, key, label in zip(
        axes[0],
        ("position_rmse_m", "heading_rmse_deg"),
        ("position RMSE [m]", "heading RMSE [deg]"),
        strict=True,
    ):
        bars = axis.bar(names, [row[key] for row in rows], color=colours)
        axis.bar_label(bars, fmt="%.3g")
        axis.set(ylabel=label, yscale="log")
        axis.margins(y=0.25)
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment, and print its table."""
    given = common.parse(__doc__, argv, runs=100)
    use_cpu_devices()
    numbers = compute(given.seed, given.frontend.segments)
    common.save(given.out, "baselines", numbers, draw)
    print(f"{'':16}position  heading   NEES  diverged")
    for row in numbers["rows"]:
        nees = "-" if row["nees"] is None else f"{row['nees']:.2f}"
        print(
            f"{row['name']:16}{row['position_rmse_m']:6.3f} m {row['heading_rmse_deg']:6.2f} deg"
            f"{nees:>6}{row['diverged']:6d}"
        )


if __name__ == "__main__":
    main()
