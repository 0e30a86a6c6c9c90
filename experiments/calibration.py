"""Whether tuning finds the systematic errors of a simulated robot, from any start.

Its wheels are 5 % too large and 3 % too small and 4 % further apart than its odometry assumes, its
scanner is 25 cm ahead of where it is taken to be and turned by 3 degrees, and its clocks are 80 ms
apart (`calibration_drives.HURT`). Noise and calibration are tuned together, by the innovations'
likelihood, which needs no truth, and by the likelihood of the true poses. Peers: the noise alone,
and the closed form of Censi et al. on the true motion of the scanner. The same command resumes
where it was stopped.
"""

import sys
from functools import partial
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from experiments import calibration_drives, common
from experiments.calibration_drives import CONFIG, HURT
from experiments.closed_form_calibration import closed_form
from jaxslam.core import se2_np
from jaxslam.core.caches import enable_caches
from jaxslam.core.calibration import Calibration
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.episode import Episode
from jaxslam.evaluation import summary
from jaxslam.pipeline import episodes
from jaxslam.tuning import fitting, parameters, standard_errors
from jaxslam.tuning.calibrated import CalibratedParams, calibrate_episode, calibrated_slam_model

NAME = "calibration"
LOSSES = ("innovation_nll", "pose_nll")
MODEL = calibrated_slam_model(CONFIG, scan_period=HURT.scan_period, wheel_base=HURT.wheel_base)
STAGES = ((16, 30, ("noise",)), (16, 20, ()), (None, 30, ()))  # drives, updates, what is frozen
CAUTION = 5.0  # factor on the odometry's noise at a start, so that a robot that is off is possible
FACTOR = 2.0  # within which each noise of a start is off
REPETITION_RUNS, REPETITION_UPDATES = 16, 15
STRAIGHT = [(1.0, 1.0), (4.5, 1.0)]
STRAIGHT_RUNS = 8
UNCALIBRATED_UPDATES = 30
NOISE_NUMBERS = 8  # of the parameters, before those of the calibration


def true_params() -> CalibratedParams:
    """The robot as it is; its noise is that of the encoders, at the wheels."""
    return CalibratedParams(calibration_drives.measurement_noise(), HURT.calibration())


def start_of(seed: int, number: int) -> CalibratedParams:
    """A robot that is taken to be without errors, give or take a unit of each transform."""
    truth = true_params()
    rng = np.random.default_rng([seed, number])
    theta = parameters.flatten_params(truth._replace(calibration=Calibration.identity()))
    theta[NOISE_NUMBERS:] += rng.uniform(-1.0, 1.0, len(theta) - NOISE_NUMBERS)
    theta[:NOISE_NUMBERS] += np.log(FACTOR) * rng.uniform(-1.0, 1.0, NOISE_NUMBERS)
    theta[:4] += np.log(CAUTION)
    return parameters.unflatten_params(theta, truth)


def recover(loss: str, params: CalibratedParams, train: Episode, test: Episode) -> common.Numbers:
    """Tune from a start, at first on a part of the drives."""
    for count, updates, frozen in STAGES:
        drives = common.take(train, slice(count))
        found = fitting.tune(MODEL, params, drives, loss=loss, num_updates=updates, frozen=frozen)
        params = found.params
    return {
        "theta": parameters.flatten_params(params),
        "loss": found.loss[found.best],
        "heldout_rmse_m": position_rmse(params, test),
    }


def position_rmse(params: CalibratedParams, drives: Episode) -> float:
    """Position RMSE [m] of the filter on drives [B], calibrated by the parameters."""
    own = partial(
        calibrate_episode,
        params.calibration,
        scan_period=HURT.scan_period,
        wheel_base=HURT.wheel_base,
    )
    results = episodes.filter_episodes(CONFIG, params.noise, jax.jit(jax.vmap(own))(drives))
    return summary.evaluate(results)["position_rmse_m"]


def compute_loss(
    loss: str,
    seed: int,
    sizes: tuple[int, int],
    train: Episode,
    test: Episode,
    true_rmse: float,
    cache: common.ResultCache,
) -> common.Numbers:
    """Tune by a loss from all starts; compare with the truth, in standard errors.

    Args:
        loss: Its name.
        seed: Of the starts and of the drives of the repetitions.
        sizes: Number of starts and of repetitions.
        train: Drives to tune on.
        test: Held-out drives.
        true_rmse: [m] position RMSE of the calibrated robot on these.
        cache: Of partial results.
    """
    starts, repetitions = sizes
    truth, rows = parameters.flatten_params(true_params()), []
    for number in tqdm(range(starts), unit="start", desc=loss, leave=False):
        make = partial(recover, loss, start_of(seed, number), train, test)
        rows.append(cache(f"{loss} start {number}", make))
    best = parameters.unflatten_params(min(rows, key=lambda x: x["loss"])["theta"], true_params())
    errors = cache(f"{loss} standard errors", partial(_errors, loss, best, train))
    se = np.array([np.nan if x is None else x for x in errors["relative"]])
    repeated = []
    for number in tqdm(range(repetitions), unit="repetition", desc=loss, leave=False):
        make = partial(_repeat, loss, seed, number, best)
        repeated.append(cache(f"{loss} repetition {number}", make)["theta"])
    off = np.array([row["theta"] for row in rows]) - truth
    own = np.arange(len(truth)) >= NOISE_NUMBERS
    shown = own & np.array(errors["identifiable"])
    ratio = np.array([row["heldout_rmse_m"] for row in rows]) / true_rmse
    smaller = np.sqrt(len(train.odometry) / REPETITION_RUNS)
    spread = np.std(repeated, axis=0, ddof=1) if repetitions > 1 else np.full(len(truth), np.nan)
    z = off / se
    return {
        "loss": loss,
        "starts": starts,
        "within_3_se": int(np.sum(np.all(np.abs(z[:, shown]) < 3.0, axis=1))),
        "worst_z": float(np.abs(z[:, shown]).max(initial=0.0)),
        "heldout_ratio": [float(ratio.min()), float(ratio.max())],
        "names": errors["names"],
        "identifiable": errors["identifiable"],
        "standard_errors": se,
        "in_units": errors["in_units"],
        "warnings": errors["warnings"],
        "repetitions": repetitions,
        "error_per_spread": smaller * se / spread,
        "truth": truth,
        "rows": rows,
    }


def _errors(loss: str, params: CalibratedParams, drives: Episode) -> common.Numbers:
    """Standard errors of parameters, and those of the calibration in its own units."""
    found = standard_errors.standard_errors(MODEL, params, drives, loss=loss)
    in_units = dict(zip(Calibration._fields, found.of_params.calibration, strict=True))
    kept = ("names", "relative", "identifiable", "warnings")
    return {key: getattr(found, key) for key in kept} | {"in_units": in_units}


def _repeat(loss: str, seed: int, number: int, params: CalibratedParams) -> common.Numbers:
    """Tune on other drives."""
    key = jax.random.fold_in(jax.random.key(seed), 1 + number)
    drives = calibration_drives.drives(key, HURT, num_trials=REPETITION_RUNS)
    found = fitting.tune(MODEL, params, drives, loss=loss, num_updates=REPETITION_UPDATES)
    return {"theta": parameters.flatten_params(found.params)}


def peers(train: Episode, test: Episode) -> common.Numbers:
    """Held-out errors of the calibrated robot, of noise alone, and of the closed form."""
    truth = true_params()
    still = truth._replace(calibration=Calibration.identity())
    cautious = parameters.flatten_params(still)
    cautious[:4] += np.log(CAUTION)
    noise = fitting.tune(
        MODEL,
        parameters.unflatten_params(cautious, still),
        common.take(train, slice(REPETITION_RUNS)),
        loss=LOSSES[0],
        num_updates=UNCALIBRATED_UPDATES,
        frozen=("calibration",),
    )
    own = closed_form_of(train)
    return {
        "true_calibration_rmse_m": position_rmse(truth, test),
        "uncalibrated_rmse_m": position_rmse(still, test),
        "noise_alone_rmse_m": position_rmse(noise.params, test),
        "closed_form_rmse_m": position_rmse(truth._replace(calibration=own), test),
        "closed_form": own._asdict(),
    }


def closed_form_of(drives: Episode) -> Calibration:
    """The closed form on the true motion of the scanner, which no scan matching knows better."""
    motion = np.concatenate([se2_np.increments(truth)[1:] for truth in drives.truth])
    odometry = np.concatenate(drives.odometry[:, 1:])
    return closed_form(odometry, motion, wheel_base=HURT.wheel_base)


def straight(seed: int, num_scans: int) -> common.Numbers:
    """What drives straight ahead do not determine."""
    drives = calibration_drives.drives(
        jax.random.key(seed), HURT, num_trials=STRAIGHT_RUNS, path=STRAIGHT, num_scans=num_scans
    )
    return _errors(LOSSES[0], true_params(), drives)


def draw(numbers: common.Numbers, path: Any) -> None:
    """Results of all starts in standard errors, and held-out errors."""
    figure, axes = common.canvas(13, 4.6, 1, 2, [3, 2])
    left, right = axes[0]
    for row, colour, side in zip(
        numbers["rows"], (common.GREEN, common.PINK), (-0.15, 0.15), strict=True
    ):
        z = np.array([one["theta"] for one in row["rows"]]) - np.array(row["truth"])
        z = z / np.array([np.nan if x is None else x for x in row["standard_errors"]])
        for i in range(NOISE_NUMBERS, z.shape[1]):
            left.plot(np.full(len(z), i + side), z[:, i], "D", color=colour, markersize=4)
        left.plot([], [], "D", color=colour, label=row["loss"])
    left.axhspan(-3, 3, color=common.BLACK, alpha=0.1, label="3 standard errors")
    names = [name.removeprefix("calibration.") for name in numbers["rows"][0]["names"]]
    ticks = range(NOISE_NUMBERS, len(names))
    left.set_xticks(ticks, names[NOISE_NUMBERS:], rotation=20, ha="right")
    left.set(ylabel="error [standard errors]", title="all starts")
    left.legend(fontsize="small")
    bars = {
        "no calibration": numbers["peers"]["uncalibrated_rmse_m"],
        "noise tuned alone": numbers["peers"]["noise_alone_rmse_m"],
        "closed form": numbers["peers"]["closed_form_rmse_m"],
        "true calibration": numbers["peers"]["true_calibration_rmse_m"],
    }
    for row in numbers["rows"]:
        bars[row["loss"]] = row["heldout_ratio"][1] * bars["true calibration"]
    right.barh(list(bars), [100 * x for x in bars.values()], color=common.SKY)
    for place, value in enumerate(bars.values()):
        right.text(100 * value, place, f" {100 * value:.2f}", va="center")
    right.set(xlabel="held-out position RMSE [cm], of the worst start", xscale="log")
    figure.savefig(path)


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(__doc__, argv, starts=20, runs=64, heldout=32, repetitions=40)
    use_cpu_devices()
    enable_caches()
    about = {key: str(value) for key, value in vars(args).items() if key != "out"}
    cache = common.ResultCache(args.out / f"{NAME}_parts", about)
    total = args.runs + args.heldout
    drives = calibration_drives.drives(jax.random.key(args.seed), HURT, num_trials=total)
    train, test = (common.take(drives, part) for part in (slice(args.runs), slice(args.runs, None)))
    others = cache("peers", partial(peers, train, test))
    along = cache("straight", partial(straight, args.seed, drives.odometry.shape[1]))
    sizes, reference = (args.starts, args.repetitions), others["true_calibration_rmse_m"]
    rows = [compute_loss(loss, args.seed, sizes, train, test, reference, cache) for loss in LOSSES]
    numbers = {"seed": args.seed, "runs": args.runs, "heldout": args.heldout}
    numbers |= {"rows": rows, "peers": others, "straight": along}
    common.save(args.out, NAME, numbers, draw)
    cache.clear()
    for row in rows:
        print({key: row[key] for key in ("loss", "starts", "within_3_se", "worst_z", "warnings")})
        print("  held-out RMSE per that of the true calibration:", row["heldout_ratio"])
        for name, ratio in zip(row["names"], row["error_per_spread"], strict=True):
            if name.startswith("calibration."):
                print(f"  {name}: standard error per spread {ratio:.2f}")
    print({key: value for key, value in others.items() if key.endswith("rmse_m")})
    print("straight drives:", *along["warnings"])
    return 0


if __name__ == "__main__":
    sys.exit(main())
