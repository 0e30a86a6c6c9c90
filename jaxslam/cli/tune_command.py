"""The command `jaxslam tune`: noise parameters fitted to simulated drives or to recorded logs."""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import jax
import numpy as np
import tyro
from tqdm import tqdm

from jaxslam.cli import calibrated_logs, summaries, tune_report
from jaxslam.cli.log_options import Scanner, ScannerOptions
from jaxslam.cli.options import (
    Files,
    OptionalCount,
    OptionalFile,
    OutFolder,
    check_range,
    name_errors,
)
from jaxslam.cli.stopwatch import stopwatch
from jaxslam.cli.tune_jobs import TuneJob, recorded_task, simulated_task
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.episode import Episode
from jaxslam.core.types import Metrics
from jaxslam.evaluation import (
    ConsistencyReport,
    filter_with_statistics,
    slam_consistency,
    summary,
)
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import calibration_file, checkpoint, noise_file
from jaxslam.io.errors import InputError
from jaxslam.io.output import folder, write_json
from jaxslam.tuning import fitting, losses, optimizers, parameters, standard_errors, tune_state
from jaxslam.tuning.losses import Loss
from jaxslam.tuning.problem import StartError
from jaxslam.tuning.tune_state import TuneResult, TuneState

PARAMS_FILE, CHECKPOINT_FILE = "noise.json", "tune.npz"
CALIBRATION_FILE = "calibration.json"


class _Settings(NamedTuple):
    """Settings of the optimisation, as `fitting.tune` takes them."""

    loss: Loss
    frozen: tuple[str, ...]
    num_updates: int
    batch_size: int | None
    seed: int
    patience: int | None


def tune(
    logs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="[LOG ...]", help_behavior_hint=""),
    ] = (),
    test: Files = (),
    reference: Files = (),
    odometry: Literal["scan", "wheels"] = "scan",
    world: str = "office",
    trials: int = 32,
    heldout: int = 16,
    loss: Literal[
        "pose_nll", "pose_mse", "innovation_nll", "prediction_nll", "closure_nll"
    ] = "pose_nll",
    updates: int = 30,
    batch: OptionalCount = None,
    patience: OptionalCount = None,
    freeze: Annotated[
        tuple[str, ...], tyro.conf.arg(metavar="NAME ...", help_behavior_hint="")
    ] = (),
    noise: OptionalFile = None,
    calibrate: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    scanner: Scanner = ScannerOptions(),  # noqa: B008
    seed: int = 0,
    out: OutFolder = Path("out"),
) -> None:
    """Tune the noise parameters of the filter (Q and R) on logs or on simulated trials.

    Writes noise.json, which --noise of the other commands reads; metrics.json with the errors
    before and after, the standard errors of the parameters, and tests of the filter's consistency;
    history.png; and report.png, all of it on one page, with findings in words. When interrupted,
    noise.json holds the best parameters so far, and the same command resumes the tuning.

    The parameters are the four coefficients of the odometry noise (Q); standard deviations of range
    and bearing, of a wall's direction, and a factor on the front end's own (R); and a factor on
    those of scan matching. They are optimised by gradient. Parameters of data association, such as
    the gate, are not differentiable and are not tuned.

    Args:
        logs: Laser logs, as `jaxslam run` reads them, or folders of MRCLAM data sets (FOLDER for
            all of its robots, FOLDER/Robot2 for one); none: simulated trials.
        test: Held-out logs, for evaluation only.
        reference: Reference trajectory, a TUM file, of each laser log: first of the logs to tune
            on, then of --test; MRCLAM data sets contain theirs.
        odometry: For laser logs: scan matching fused with wheel odometry (scan), or wheel odometry
            alone (wheels).
        world: World of the simulated trials.
        trials: Number of simulated trials to tune on.
        heldout: Number of simulated held-out trials, for evaluation only.
        loss: Loss to minimise. pose_nll: negative log density of the true pose, which needs both
            accuracy and a consistent covariance; pose_mse: squared pose error alone, which leaves
            the scale of the noise undetermined. The others need no reference. innovation_nll:
            negative log-likelihood of the innovations, for white noise; prediction_nll: that of the
            map of each part of 64 steps, predicted from all before; closure_nll: that of landmarks
            seen again after more than 64 steps; both for errors of the sensor that last.
        updates: Updates of the optimiser: L-BFGS, or Adam with --batch.
        batch: Episodes (logs or trials) per update (minibatch); by default all.
        patience: Stop after this many evaluations without improvement; by default never.
        freeze: Parameters that are not tuned: odometry_coefficients, odometry_coefficients[0] ...
            odometry_coefficients[3], range_std, bearing_std, feature_std_scale, wall_angle_std,
            scan_match_std_scale.
        noise: File of the initial noise parameters (Q and R); by default cautious ones.
        calibrate: Of laser logs of one robot: calibrate it first, its wheels, the scanner's mount
            and the clocks of both, by scan matching against odometry, and write calibration.json,
            which --calibration of `jaxslam run` reads. The noise is then that of the calibrated
            robot.
        scanner: The scanner and the frames of laser logs.
        seed: Random seed of the simulation and of the order of the minibatches.
        out: Folder for the results.
    """
    use_cpu_devices()
    check_range("--updates", updates, 1, 10**5)
    check_range("--seed", seed, 0, 2**32 - 1)
    check_range("--batch", 1 if batch is None else batch, 1, 10**6)
    check_range("--patience", 1 if patience is None else patience, 1, 10**6)
    if patience is not None and not (test if logs else heldout):
        advice = "name some by --test, or give simulated ones by --heldout"
        raise InputError("needs held-out runs", field="--patience", advice=advice)
    if noise is not None and noise.resolve() == (out / PARAMS_FILE).resolve():
        advice = "name another folder by --out"
        raise InputError("would be replaced by the result", path=noise, advice=advice)
    settings = _Settings(losses.BY_NAME[loss], freeze, updates, batch, seed, patience)
    with name_errors("--freeze"):
        parameters.trainable_mask(NoiseParams.for_laser_log(match_scans=True), freeze)
    if logs:
        match_scans = odometry == "scan"
        task = recorded_task(
            logs,
            test,
            reference,
            noise,
            match_scans=match_scans,
            loss=settings.loss,
            scanner=scanner,
            calibrate=calibrate,
        )
    else:
        if calibrate:
            raise InputError("applies to laser logs only", field="--calibrate")
        if test or reference:
            raise InputError("apply to logs only", field="--test, --reference")
        check_range("--trials", trials, 1, 10**6)
        check_range("--heldout", heldout, 0, 10**6)
        task = simulated_task(world, trials, heldout, noise, seed)
    with name_errors("--freeze"):  # again, of the parameters that this task has
        parameters.trainable_mask(task.params, freeze)
    if not calibrate and (out / CALIBRATION_FILE).exists():
        stays = f"{out / CALIBRATION_FILE} of an earlier tuning stays there"
        print(f"note: {stays}; this noise is not that of the calibrated robot", flush=True)
    with folder(out) as out_dir:
        enable_caches()
        with stopwatch() as seconds:
            job = task.load()
            if job.robot is not None:
                calibration_file.write(out_dir / CALIBRATION_FILE, job.robot)
            found = _tune(job, out, settings)
            with _resumable(out, lambda: "all evaluations"):
                numbers, report = _evaluate(job, found, settings)
        numbers |= {"seconds": seconds}
        if job.robot is not None:
            numbers["calibration"] = calibrated_logs.metrics_of(job.robot)
        noise_file.write(out_dir / PARAMS_FILE, found.params)
        write_json(out_dir / "metrics.json", numbers)
        _draw_history(out_dir / "history.png", found)
        tune_report.draw_report(out_dir / "report.png", job.title, numbers, found, report)
    (out / CHECKPOINT_FILE).unlink(missing_ok=True)
    summaries.print_tuning_summary(numbers, job.title, out)


def _tune(job: TuneJob, out: Path, settings: _Settings) -> TuneResult:
    """Tune, resuming from a checkpoint in `out`; write one after each evaluation."""
    about = {
        "config": repr(job.config),
        "loss": losses.name_of(settings.loss),
        "frozen": sorted(settings.frozen),
        "updates": settings.num_updates,
        "batch": settings.batch_size,
        "seed": settings.seed,
        "patience": settings.patience,
        "noise to start from": job.params,
        "episodes": _hash(job.train),
        "heldout": _hash(job.test),
    }
    file, state, num_updates = out / CHECKPOINT_FILE, None, settings.num_updates
    whole = settings.batch_size is None or settings.batch_size >= len(job.train.odometry)
    if file.exists():
        optimizer = optimizers.default_optimizer(num_updates, whole=whole)
        template = tune_state.init(
            job.params, num_updates=num_updates, frozen=settings.frozen, optimizer=optimizer
        )
        state = checkpoint.read(file, template, about)
        print(f"resuming after evaluation {int(state.step)} of {num_updates + 1}", flush=True)
    done = 0 if state is None else int(state.step)
    bar = tqdm(total=num_updates + 1, initial=done, desc="compiling", mininterval=0)

    def save(state: TuneState) -> None:
        nonlocal done
        done = int(state.step)
        out.mkdir(parents=True, exist_ok=True)
        best = tune_state.result(state, job.params, whole=whole).params
        noise_file.write(out / PARAMS_FILE, best)
        checkpoint.write(file, state, about)
        heldout = state.heldout[np.isfinite(state.heldout)]
        postfix = {"loss": f"{state.loss[done - 1]:.4g}"}
        postfix |= {"heldout": f"{heldout[-1]:.4g}"} if heldout.size else {}
        bar.set_description("tuning", refresh=False)
        bar.set_postfix(postfix, refresh=False)
        bar.update(done - bar.n)

    with (
        _resumable(out, lambda: done and f"{done} of {num_updates + 1} evaluations"),
        bar,
        _name_start(job.title),
    ):
        return fitting.tune(
            job.config,
            job.params,
            job.train,
            loss=settings.loss,
            num_updates=num_updates,
            batch_size=settings.batch_size,
            seed=settings.seed,
            frozen=settings.frozen,
            heldout=job.test,
            patience=settings.patience,
            state=state,
            callback=save,
        )


@contextmanager
def _name_start(title: str) -> Iterator[None]:
    """Let a tuning that has nothing to minimise end in an InputError that names its data."""
    try:
        yield
    except StartError as error:
        raise InputError(str(error), field=title) from None


@contextmanager
def _resumable(out: Path, done: Callable[[], str | int]) -> Iterator[None]:
    """Let the message of a Ctrl-C in the block say how to resume, if `done` is not 0."""
    try:
        yield
    except KeyboardInterrupt:
        if not done():
            raise
        raise KeyboardInterrupt(
            f"interrupted after {done()}; {out / PARAMS_FILE} holds the best parameters so far, "
            "and the same command resumes"
        ) from None


def _evaluate(
    job: TuneJob, found: TuneResult, settings: _Settings
) -> tuple[Metrics, tune_report.TuneReport]:
    """Errors and consistency before and after the tuning, standard errors of the parameters."""
    evaluated = job.train if job.test is None else job.test

    def errors(params: NoiseParams) -> tuple[Metrics, ConsistencyReport | None]:
        asked = None if losses.comparisons(settings.loss) else settings.loss
        results, statistics = filter_with_statistics(job.config, params, evaluated, loss=asked)
        if statistics.loss is None:  # it compares two filters
            loss = fitting.values(job.config, params, evaluated, settings.loss)
        else:
            loss = np.asarray(statistics.loss)
        numbers: Metrics = {"loss": float(np.mean(loss[np.isfinite(loss)]))}
        if evaluated.truth_mask is None or evaluated.truth_mask.any():
            numbers |= summary.evaluate(results)
        return numbers, slam_consistency(results, statistics)

    print("evaluating errors before and after, and standard errors ...", flush=True)
    numbers, after = errors(found.params)
    numbers_before, before = errors(job.params)
    numbers |= {
        "judged_on": "the runs it was tuned on" if job.test is None else "held-out runs",
        "before": numbers_before | {"noise": noise_file.to_keys(job.params)},
        "evaluations": len(found.loss),
        "best": found.best,
        "skipped": int(found.skipped.sum()),
        "noise": noise_file.to_keys(found.params),
        "standard_errors": None,
        "warnings": ["no standard errors: they need two episodes at least"],
    }
    sure = None
    if len(job.train.odometry) >= 2:
        sure = standard_errors.standard_errors(
            job.config, found.params, job.train, loss=settings.loss, frozen=settings.frozen
        )
        keys = map(noise_file.key_of, sure.names)
        numbers["standard_errors"] = dict(zip(keys, sure.relative.tolist(), strict=True))
        numbers["warnings"] = list(sure.warnings)
    report = tune_report.TuneReport(
        before=before,
        after=after,
        start=job.params,
        found=found.params,
        frozen=~parameters.trainable_mask(found.params, settings.frozen),
        errors=sure,
    )
    return numbers | tune_report.report_blocks(report), report


def _hash(episodes: Episode | None) -> str:
    """Hash of the content of episodes."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(episodes):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:16]


def _draw_history(path: Path, found: TuneResult) -> None:
    """Draw losses and parameters over the evaluations of a tuning."""
    from jaxslam.viz import canvas, charts  # imported here, because matplotlib is slow to import

    figure, axes = canvas.canvas(11.0, 4.0, 1, 2)
    charts.draw_losses(axes[0, 0], found.loss, found.heldout, found.best)
    values = [np.asarray(x).reshape(len(found.loss), -1) for x in jax.tree.leaves(found.history)]
    charts.draw_parameters(
        axes[0, 1], parameters.param_names(found.params), np.concatenate(values, axis=1), found.best
    )
    figure.savefig(path)
