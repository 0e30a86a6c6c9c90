"""Noise by gradient: from three times too large, tuned on some runs and judged on others.

The simulated robot's true encoder noise is known, and so is what its front end's landmarks are
worth; the filter starts with all of it three times too large.
"""

from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from experiments import common
from jaxslam import fit, monte_carlo, slam
from jaxslam.losses import calibrated

FACTOR = 3.0


def compute(seed: int, runs: int, heldout: int, steps: int) -> common.Numbers:
    """Tune on `runs` runs; position RMSE on `heldout` others, before, after and with the truth."""
    config = slam.Config(landmarks=64)
    place, robot, path, scans = common.scene()
    logs = monte_carlo.simulate(
        jax.random.key(seed), config, place, robot, path, runs=runs + heldout, steps=scans
    )
    train = jax.tree.map(lambda x: x[:runs], logs)
    test = jax.tree.map(lambda x: x[runs:], logs)
    truth = slam.wheel_noise(robot)
    start = jax.tree.map(lambda x: FACTOR * x, truth)
    with tqdm(total=steps + 1, unit="step", leave=False) as bar:

        def report(state: fit.State) -> None:
            bar.set_postfix(loss=f"{state.loss[state.step - 1]:.4g}")
            bar.update()

        found = fit.tune(start, config, train, loss=calibrated, steps=steps, report=report)
    judged = {
        name: monte_carlo.evaluate(monte_carlo.tracks(config, noise, test))
        for name, noise in (("start", start), ("tuned", found.noise), ("true_noise", truth))
    }
    fields = lambda noise: {k: np.asarray(v) for k, v in noise._asdict().items()}
    return {
        "seed": seed,
        "runs": runs,
        "heldout": heldout,
        **{f"heldout_rmse_{name}_m": e["position_rmse_m"] for name, e in judged.items()},
        **{f"heldout_heading_{name}_deg": e["heading_rmse_deg"] for name, e in judged.items()},
        **{f"heldout_nees_{name}": e["nees"] for name, e in judged.items()},
        "loss": found.loss,
        "history": fields(found.history),
        "noise": {
            name: fields(noise)
            for name, noise in (("start", start), ("tuned", found.noise), ("true_noise", truth))
        },
    }


def draw(numbers: common.Numbers, path: Path) -> None:
    """Loss and noise over the steps, errors before and after."""
    figure, axes = common.canvas(12, 3.6, 1, 3)
    loss, bars, noise = axes[0]
    loss.plot(numbers["loss"], color=common.BLUE)
    loss.set(xlabel="step", ylabel="training loss [nats a pose]")
    names = ("start", "tuned", "true_noise")
    drawn = bars.bar(
        [name.replace("_", "\n") for name in names],
        [100 * numbers[f"heldout_rmse_{name}_m"] for name in names],
        color=(common.ORANGE, common.GREEN, common.BLACK),
    )
    bars.bar_label(drawn, fmt="%.2f")
    bars.set(ylabel="held-out position RMSE [cm]")
    true = numbers["noise"]["true_noise"]
    colours = iter((common.BLACK, common.ORANGE, common.SKY, common.GREEN, common.BLUE))
    for name, values in numbers["history"].items():
        ratio = np.array(values) / np.array(true[name])
        colour = next(colours)
        noise.plot(ratio, color=colour)
        noise.plot([], color=colour, label=name)
    noise.axhline(1.0, color=common.PINK, linestyle="--")
    noise.set(xlabel="step", ylabel="noise / true noise", yscale="log")
    noise.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    given = common.parse(__doc__, argv, runs=16, heldout=32, steps=30)
    numbers = compute(given.seed, given.runs, given.heldout, given.steps)
    common.save(given.out, "tuning", numbers, draw)
    for name in ("start", "tuned", "true_noise"):
        print(f"held-out RMSE, {name:10}: {100 * numbers[f'heldout_rmse_{name}_m']:.2f} cm")


if __name__ == "__main__":
    main()
