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

from jaxslam.cli import report, summaries
from jaxslam.cli.options import check_range, enable_caches, name_errors, stopwatch
from jaxslam.cli.tune_jobs import TuneJob, recorded_job, simulated_job
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.episode import Episode
from jaxslam.evaluation import summary
from jaxslam.evaluation.log_errors import Metrics
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import checkpoint, noise_file
from jaxslam.io.errors import InputError
from jaxslam.io.output import folder, write_json
from jaxslam.pipeline import episodes
from jaxslam.tuning import fitting, losses, optimizers, parameters
from jaxslam.tuning import standard_errors as standard_errors_module
from jaxslam.tuning.fitting import TuneResult, TuneState
from jaxslam.tuning.losses import Loss

PARAMS_FILE, CHECKPOINT_FILE = "noise.json", "tune.npz"


class _Settings(NamedTuple):
    """Settings of the optimisation, as `fitting.tune` takes them."""

    loss: Loss
    frozen: tuple[str, ...]
    steps: int
    batch: int | None
    seed: int
    patience: int | None


def tune(
    logs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="[LOG ...]")
    ] = (),
    test: tuple[Path, ...] = (),
    reference: tuple[Path, ...] = (),
    odometry: Literal["scan", "wheels"] = "scan",
    world: str = "office",
    runs: int = 32,
    heldout: int = 16,
    loss: Literal["calibrated", "localisation", "likelihood"] = "calibrated",
    steps: int = 30,
    batch: int | None = None,
    patience: int | None = None,
    freeze: tuple[str, ...] = (),
    noise: Path | None = None,
    seed: int = 0,
    out: Path = Path("out"),
) -> None:
    """Tune the noise parameters of the filter (Q and R) on logs or on simulated runs.

    Writes noise.json, which --noise of the other commands reads; metrics.json with the errors
    before and after, and the standard errors of the parameters; and history.png. When interrupted,
    noise.json holds the best parameters so far, and the same command resumes the tuning.

    The parameters are the four coefficients of the odometry noise, range, bearing, scale and wall
    of the measurement noise, and the factor on the uncertainty of scan matching (alignment). They
    are optimised by gradient. Parameters of data association, such as the gate, are not
    differentiable and are not tuned.

    Args:
        logs: Laser logs, as `jaxslam run` reads them, or folders of MRCLAM data sets (FOLDER for
            all of its robots, FOLDER/Robot2 for one); none: simulated runs.
        test: Held-out logs, for evaluation only.
        reference: Reference trajectory, a TUM file, of each laser log: first of the logs to tune
            on, then of --test; MRCLAM data sets contain theirs.
        odometry: For laser logs: scan matching fused with wheel odometry (scan), or wheel odometry
            alone (wheels).
        world: World of the simulated runs.
        runs: Number of simulated runs to tune on.
        heldout: Number of simulated held-out runs, for evaluation only.
        loss: Loss to minimise. calibrated: negative log density of the true pose, which needs both
            accuracy and a consistent covariance; localisation: pose error alone, which leaves the
            scale of the noise undetermined; likelihood: negative log-likelihood of the innovations,
            the only one that needs no reference.
        steps: Updates of the optimiser: L-BFGS, or Adam with --batch.
        batch: Runs per update (minibatch); by default all.
        patience: Stop after this many evaluations without improvement; by default never.
        freeze: Parameters that are not tuned: odometry, odometry[0] ... odometry[3], range,
            bearing, scale, wall, alignment.
        noise: File of the initial noise parameters (Q and R); by default cautious ones.
        seed: Random seed of the simulation and of the order of the minibatches.
        out: Folder for the results.
    """
    use_cpu_devices()
    check_range("--steps", steps, 1, 10**5)
    check_range("--seed", seed, 0, 2**32 - 1)
    check_range("--batch", 1 if batch is None else batch, 1, 10**6)
    check_range("--patience", 1 if patience is None else patience, 1, 10**6)
    if noise is not None and noise.resolve() == (out / PARAMS_FILE).resolve():
        advice = "name another folder by --out"
        raise InputError("would be replaced by the result", path=noise, advice=advice)
    settings = _Settings(losses.BY_NAME[loss], freeze, steps, batch, seed, patience)
    with name_errors("--freeze"):
        parameters.trainable_mask(NoiseParams.for_laser_log(match_scans=True), freeze)
    if logs:
        make_job = recorded_job(logs, test, reference, odometry == "scan", noise, settings.loss)
    else:
        if test or reference:
            raise InputError("apply to logs only", field="--test, --reference")
        check_range("--runs", runs, 1, 10**6)
        check_range("--heldout", heldout, 0, 10**6)
        make_job = simulated_job(world, runs, heldout, noise, seed)
    with folder(out) as out_dir:
        enable_caches()
        with stopwatch() as seconds:
            job = make_job()
            found = _tune(job, out, settings)
            with _resumable(out, lambda: "all evaluations"):
                numbers = _evaluate(job, found, settings)
        numbers |= {"seconds": seconds}
        noise_file.write(out_dir / PARAMS_FILE, found.params)
        write_json(out_dir / "metrics.json", numbers)
        report.draw_history(out_dir / "history.png", found)
    (out / CHECKPOINT_FILE).unlink(missing_ok=True)
    summaries.print_tuning_summary(numbers, job.title, out)


def _name(loss: Loss) -> str:
    """Name of a loss, as --loss takes it."""
    return next(name for name, function in losses.BY_NAME.items() if function is loss)


def _tune(job: TuneJob, out: Path, settings: _Settings) -> TuneResult:
    """Tune, resuming from a checkpoint in `out`; write one after each evaluation."""
    about = {
        "config": repr(job.config),
        "loss": _name(settings.loss),
        "frozen": sorted(settings.frozen),
        "steps": settings.steps,
        "batch": settings.batch,
        "seed": settings.seed,
        "patience": settings.patience,
        "noise to start from": job.noise,
        "runs": _hash(job.train),
        "heldout": _hash(job.test),
    }
    file, state, steps = out / CHECKPOINT_FILE, None, settings.steps
    whole = settings.batch is None or settings.batch >= len(job.train.odometry)
    if file.exists():
        optimiser = optimizers.default_optimizer(steps, whole=whole)
        template = fitting.init(
            job.noise, num_updates=steps, frozen=settings.frozen, optimizer=optimiser
        )
        state = checkpoint.read(file, template, about)
        print(f"resuming after evaluation {int(state.step)} of {steps + 1}", flush=True)
    done = 0 if state is None else int(state.step)
    bar = tqdm(total=steps + 1, initial=done, desc="compiling", mininterval=0)

    def save(state: TuneState) -> None:
        nonlocal done
        done = int(state.step)
        out.mkdir(parents=True, exist_ok=True)
        noise_file.write(out / PARAMS_FILE, fitting.result(state, job.noise, whole=whole).params)
        checkpoint.write(file, state, about)
        heldout = state.heldout[np.isfinite(state.heldout)]
        postfix = {"loss": f"{state.loss[done - 1]:.4g}"}
        postfix |= {"heldout": f"{heldout[-1]:.4g}"} if heldout.size else {}
        bar.set_description("tuning", refresh=False)
        bar.set_postfix(postfix, refresh=False)
        bar.update(done - bar.n)

    with _resumable(out, lambda: done and f"{done} of {steps + 1} evaluations"), bar:
        return fitting.tune(
            job.config,
            job.noise,
            job.train,
            loss=settings.loss,
            num_updates=steps,
            batch_size=settings.batch,
            seed=settings.seed,
            frozen=settings.frozen,
            heldout=job.test,
            patience=settings.patience,
            state=state,
            callback=save,
        )


@contextmanager
def _resumable(out: Path, done: Callable[[], str | int]) -> Iterator[None]:
    """Let the message of a Ctrl-C in the block say how to resume, if `done` is not 0."""
    try:
        yield
    except KeyboardInterrupt:
        if not done():
            raise
        raise KeyboardInterrupt(
            f"interrupted after {done()}; {out / PARAMS_FILE} holds the best parameters so far, and the "
            "same command resumes"
        ) from None


def _evaluate(job: TuneJob, found: TuneResult, settings: _Settings) -> Metrics:
    """Errors before and after the tuning, and standard errors of the parameters."""
    runs = job.train if job.test is None else job.test

    def errors(noise: NoiseParams) -> Metrics:
        loss = fitting.values(job.config, noise, runs, settings.loss)
        numbers = {"loss": float(np.mean(loss[np.isfinite(loss)]))}
        if runs.truth_mask is None or runs.truth_mask.any():
            numbers |= summary.evaluate(episodes.filter_episodes(job.config, noise, runs))
        return numbers

    print("evaluating errors before and after, and standard errors ...", flush=True)
    numbers = errors(found.params) | {
        "judged_on": "the runs it was tuned on" if job.test is None else "held-out runs",
        "before": errors(job.noise) | {"noise": job.noise},
        "evaluations": len(found.loss),
        "best": found.best,
        "skipped": int(found.skipped.sum()),
        "noise": found.params,
        "standard_errors": None,
        "warnings": ["no standard errors: they need two runs at least"],
    }
    if len(job.train.odometry) >= 2:
        standard_errors = standard_errors_module.standard_errors(
            job.config, found.params, job.train, loss=settings.loss, frozen=settings.frozen
        )
        relative = dict(zip(standard_errors.names, standard_errors.relative, strict=True))
        numbers |= {"standard_errors": relative, "warnings": list(standard_errors.warnings)}
    return numbers


def _hash(logs: Episode | None) -> str:
    """Hash of the content of logs."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(logs):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:16]
