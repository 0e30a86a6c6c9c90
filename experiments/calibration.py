"""Whether tuning finds the systematic errors of a simulated robot, from any start.

Its wheels are 5 % too large and 3 % too small and 4 % further apart than its odometry assumes, its
scanner is 25 cm ahead of where it is taken to be and turned by 3 degrees, and its clocks are 80 ms
apart (`calibration_drives.HURT`). Noise and calibration are tuned together, by the innovations'
likelihood, which needs no truth, and by the likelihood of the true poses. Peers: the noise alone,
and the closed form of Censi et al. on the true motion of the scanner. Then recorded logs of the
same robot, which calibrate themselves by their scans (`calibration_scans`). The same command
resumes where it was stopped.
"""

import sys
from functools import partial

import jax
import numpy as np
from tqdm import tqdm

from experiments import calibration_drives, calibration_scans, common
from experiments.calibration_drives import CONFIG, HURT
from experiments.calibration_picture import NOISE_NUMBERS, draw
from experiments.closed_form_calibration import closed_form
from jaxslam.core import se2_np
from jaxslam.core.caches import enable_caches
from jaxslam.core.calibration import Calibration
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.episode import Episode
from jaxslam.evaluation import summary
from jaxslam.io.errors import InputError
from jaxslam.pipeline import episodes
from jaxslam.simulation.robot import Robot
from jaxslam.tuning import fitting, parameters, standard_errors
from jaxslam.tuning.calibrated import CalibratedParams, calibrate_episode, calibrated_slam_model
from jaxslam.tuning.optimizers import newton
from jaxslam.tuning.tune_state import TuneResult

NAME = "calibration"
LOSSES = ("innovation_nll", "pose_nll")
MODEL = calibrated_slam_model(CONFIG, scan_period=HURT.scan_period, wheel_base=HURT.wheel_base)
PART = 16  # drives that the first two stages and each repetition are tuned on
STAGES = ((30, ("noise",)), (30, ()))  # updates of L-BFGS on these, and what is frozen
NEWTON_UPDATES = 8  # then, on all drives
CAUTION = 5.0  # factor on the odometry's noise at a start, so that a robot that is off is possible
FACTOR = 2.0  # within which each noise of a start is off
STRAIGHT = [(1.0, 1.0), (4.5, 1.0)]
NUM_STRAIGHT, STRAIGHT_NOISE = 8, 0.001  # drives, [m / sqrt(m)] of the encoders
UNCALIBRATED_UPDATES, KNOWN_UPDATES = 30, 30


def true_params() -> CalibratedParams:
    """The robot as it is; its noise is that of the encoders, at the wheels."""
    return CalibratedParams(calibration_drives.measurement_noise(), HURT.calibration())


def uncalibrated() -> CalibratedParams:
    """A robot that is taken to be without errors, its odometry's noise large."""
    still = true_params()._replace(calibration=Calibration.identity())
    theta = parameters.flatten_params(still)
    theta[:4] += np.log(CAUTION)
    return parameters.unflatten_params(theta, still)


def start_of(seed: int, number: int) -> CalibratedParams:
    """`uncalibrated`, give or take a unit of each transform, each noise within `FACTOR`."""
    truth = true_params()
    rng = np.random.default_rng([seed, number])
    theta = parameters.flatten_params(uncalibrated())
    theta[NOISE_NUMBERS:] += rng.uniform(-1.0, 1.0, len(theta) - NOISE_NUMBERS)
    theta[:NOISE_NUMBERS] += np.log(FACTOR) * rng.uniform(-1.0, 1.0, NOISE_NUMBERS)
    return parameters.unflatten_params(theta, truth)


def approach(loss: str, params: CalibratedParams, train: Episode) -> CalibratedParams:
    """Tune from a start on a part of the drives: the calibration first, then all."""
    drives = common.take(train, slice(PART))
    for updates, frozen in STAGES:
        found = fitting.tune(MODEL, params, drives, loss=loss, num_updates=updates, frozen=frozen)
        params = found.params
    return params


def hessian_of(loss: str, params: CalibratedParams, train: Episode) -> common.Numbers:
    """Hessian (P, P) of the mean loss over all drives, near the minimum that a start leads to.

    That where `approach` arrives differs too much from it along the least curved directions.
    """
    near = approach(loss, params, train)
    near = polish(loss, near, _hessian_at(loss, near, train), train).params
    return {"hessian": _hessian_at(loss, near, train)}


def _hessian_at(loss: str, params: CalibratedParams, train: Episode) -> np.ndarray:
    problem = fitting.prepare(MODEL, params, train, loss)
    theta = parameters.flatten_params(params)
    every = np.ones(len(theta), bool)
    return standard_errors.second_derivatives(problem, theta, every)[0]


def polish(loss: str, params: CalibratedParams, hessian: np.ndarray, drives: Episode) -> TuneResult:
    """The last of a tuning, on all of some drives."""
    return fitting.tune(
        MODEL,
        params,
        drives,
        loss=loss,
        num_updates=NEWTON_UPDATES,
        optimizer=newton(hessian),
    )


def recover(
    loss: str, params: CalibratedParams, hessian: np.ndarray, train: Episode, test: Episode
) -> common.Numbers:
    """Tune from a start: on a part of the drives, then on all of them."""
    found = polish(loss, approach(loss, params, train), hessian, train)
    return {
        "theta": parameters.flatten_params(found.params),
        "loss": found.loss[found.best],
        "gained": found.loss - found.loss[found.best],
        "heldout_rmse_m": position_rmse(found.params, test),
    }


def position_rmse(params: CalibratedParams, drives: Episode) -> float:
    """Position RMSE [m] of `heldout`."""
    return heldout(params, drives)["heldout_rmse_m"]


def heldout(params: CalibratedParams, drives: Episode) -> common.Numbers:
    """Errors of the filter on drives [B], calibrated by the parameters."""
    own = partial(
        calibrate_episode,
        params.calibration,
        scan_period=HURT.scan_period,
        wheel_base=HURT.wheel_base,
    )
    results = episodes.filter_episodes(CONFIG, params.noise, jax.jit(jax.vmap(own))(drives))
    found = summary.evaluate(results)
    return {"heldout_rmse_m": found["position_rmse_m"], "nees": found["nees"]}


def compute_loss(
    loss: str,
    seed: int,
    sizes: tuple[int, int],
    train: Episode,
    test: Episode,
    cache: common.ResultCache,
) -> common.Numbers:
    """Tune by a loss from all starts; compare with the truth, in standard errors.

    Args:
        loss: Its name.
        seed: Of the starts and of the drives of the repetitions.
        sizes: Number of starts and of repetitions.
        train: Drives to tune on.
        test: Held-out drives.
        cache: Of partial results.
    """
    starts, repetitions = sizes
    truth, rows = parameters.flatten_params(true_params()), []
    known = cache(f"{loss} known calibration", partial(_known, loss, train, test))
    first = partial(hessian_of, loss, start_of(seed, 0), train)
    hessian = np.array(cache(f"{loss} hessian", first)["hessian"])
    for number in tqdm(range(starts), unit="start", desc=loss, leave=False):
        make = partial(recover, loss, start_of(seed, number), hessian, train, test)
        rows.append(cache(f"{loss} start {number}", make))
    theta = min(rows, key=lambda row: row["loss"])["theta"]
    found = parameters.unflatten_params(theta, true_params())
    errors = cache(f"{loss} standard errors", partial(_errors, loss, found, train))
    se = np.array([np.nan if x is None else x for x in errors["relative"]])
    repeated = []
    for number in tqdm(range(repetitions), unit="repetition", desc=loss, leave=False):
        make = partial(_repeat, loss, seed, number, found, hessian)
        repeated.append(cache(f"{loss} repetition {number}", make)["theta"])
    off = np.array([row["theta"] for row in rows]) - truth
    own = np.arange(len(truth)) >= NOISE_NUMBERS
    shown = own & np.array(errors["identifiable"])
    ratio = np.array([row["heldout_rmse_m"] for row in rows]) / known["heldout_rmse_m"]
    smaller = np.sqrt(len(train.odometry) / PART)
    spread = np.std(repeated, axis=0, ddof=1) if repetitions > 1 else np.full(len(truth), np.nan)
    z = off / se
    best = min(range(starts), key=lambda i: rows[i]["loss"])
    apart = (off - off[best])[:, shown] / se[shown]
    others = (np.array(repeated).reshape(-1, len(truth)) - truth)[:, shown] / (smaller * se[shown])
    return {
        "loss": loss,
        "starts": starts,
        "within_3_se": int(np.sum(np.all(np.abs(z[:, shown]) < 3.0, axis=1))),
        "z": z[best],
        "starts_apart_se": float(np.abs(apart).max(initial=0.0)),
        "repetitions_within_3_se": int(np.sum(np.all(np.abs(others) < 3.0, axis=1))),
        "repetitions_mean_z": others.mean(axis=0) if repetitions else [],
        "worst_z": float(np.abs(z[:, shown]).max(initial=0.0)),
        "known_calibration_rmse_m": known["heldout_rmse_m"],
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


def _known(loss: str, train: Episode, test: Episode) -> common.Numbers:
    """The calibrated robot: the true calibration, and the noise tuned with it."""
    found = fitting.tune(
        MODEL,
        true_params(),
        train,
        loss=loss,
        num_updates=KNOWN_UPDATES,
        frozen=("calibration",),
    )
    return {"heldout_rmse_m": position_rmse(found.params, test)}


def _errors(loss: str, params: CalibratedParams, drives: Episode) -> common.Numbers:
    """Standard errors of parameters, and those of the calibration in its own units."""
    found = standard_errors.standard_errors(MODEL, params, drives, loss=loss)
    in_units = dict(zip(Calibration._fields, found.of_params.calibration, strict=True))
    kept = ("names", "relative", "identifiable", "warnings")
    return {key: getattr(found, key) for key in kept} | {"in_units": in_units}


def _repeat(
    loss: str, seed: int, number: int, params: CalibratedParams, hessian: np.ndarray
) -> common.Numbers:
    """Tune on other drives."""
    key = jax.random.fold_in(jax.random.key(seed), 1 + number)
    drives = calibration_drives.drives(key, HURT, num_trials=PART)
    found = polish(loss, params, hessian, drives)
    return {"theta": parameters.flatten_params(found.params)}


def peers(train: Episode, test: Episode) -> common.Numbers:
    """Held-out errors of the robot as it is, of noise alone, and of the closed form."""
    truth = true_params()
    still = truth._replace(calibration=Calibration.identity())
    noise = fitting.tune(
        MODEL,
        uncalibrated(),
        common.take(train, slice(PART)),
        loss=LOSSES[0],
        num_updates=UNCALIBRATED_UPDATES,
        frozen=("calibration",),
    )
    own = closed_form_of(train)
    return {
        "all_true_rmse_m": position_rmse(truth, test),
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
    """What drives straight ahead do not determine, by a robot with good wheels."""
    robot = Robot(encoder_noise=STRAIGHT_NOISE, mount=HURT.mount, time_offset=HURT.time_offset)
    drives = calibration_drives.drives(
        jax.random.key(seed), robot, num_trials=NUM_STRAIGHT, path=STRAIGHT, num_scans=num_scans
    )
    noise = calibration_drives.measurement_noise()
    own = noise.odometry_coefficients * (STRAIGHT_NOISE / HURT.encoder_noise)
    noise = noise._replace(odometry_coefficients=own)
    return _errors(LOSSES[0], CalibratedParams(noise, robot.calibration()), drives)


def logs_by_scans(seed: int, count: int, cache: common.ResultCache) -> common.Numbers:
    """What `count` recorded logs say of their robot by their scans alone."""
    make = [partial(calibration_scans.recover, seed, number) for number in range(count)]
    each = tqdm(make, unit="log", leave=False)
    return calibration_scans.summary([cache(f"log {k}", own) for k, own in enumerate(each)])


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    sizes = {"starts": 20, "runs": 64, "heldout": 32, "repetitions": 40, "logs": 20}
    args = common.parse(__doc__, argv, losses=",".join(LOSSES), **sizes)
    losses = args.losses.split(",")
    if not set(losses) <= set(LOSSES):
        raise InputError(f"--losses is {args.losses!r}, not some of {','.join(LOSSES)}")
    use_cpu_devices()
    enable_caches()
    about = {key: str(value) for key, value in vars(args).items() if key in ("seed", *sizes)}
    cache = common.ResultCache(args.out / f"{NAME}_parts", about)
    total = args.runs + args.heldout
    drives = calibration_drives.drives(jax.random.key(args.seed), HURT, num_trials=total)
    train, test = (common.take(drives, part) for part in (slice(args.runs), slice(args.runs, None)))
    others = cache("peers", partial(peers, train, test))
    along = cache("straight", partial(straight, args.seed, drives.odometry.shape[1]))
    counts = args.starts, args.repetitions
    rows = [compute_loss(loss, args.seed, counts, train, test, cache) for loss in losses]
    numbers = {"seed": args.seed, "runs": args.runs, "heldout": args.heldout}
    numbers |= {"rows": rows, "peers": others, "straight": along}
    numbers["scans"] = scans = logs_by_scans(args.seed, args.logs, cache)
    common.save(args.out, NAME, numbers, draw)
    cache.clear()
    for row in rows:
        print({key: row[key] for key in ("loss", "starts", "within_3_se", "worst_z")})
        print("  starts are apart by at most", row["starts_apart_se"], "standard errors")
        repeated = row["repetitions_within_3_se"]
        print(f"  repetitions within 3 standard errors: {repeated} of {row['repetitions']}")
        for warning in row["warnings"]:
            print("  warning:", warning)
        print("  held-out RMSE per that of the known calibration:", row["heldout_ratio"])
        for name, ratio in zip(row["names"], row["error_per_spread"], strict=True):
            if name.startswith("calibration."):
                print(f"  {name}: standard error per spread {ratio:.2f}")
    print({key: value for key, value in others.items() if key.endswith("rmse_m")})
    print("straight drives:", "; ".join(along["warnings"]))
    within, worst = scans["within_3_se"], scans["worst_z"]
    print(
        f"logs of scans: {within} of {scans['logs']} within 3 standard errors, largest {worst:.1f}"
    )
    for name, error, ratio in zip(
        scans["names"], scans["rms_error"], scans["error_per_spread"], strict=True
    ):
        print(f"  {name}: RMS error {error:.4f}, standard error per spread {ratio:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
