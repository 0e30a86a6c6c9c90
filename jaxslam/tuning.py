"""The command `jaxslam tune`: noise parameters tuned on simulated runs or on logs."""

import hashlib
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from jaxslam import curvature, descent, fit, losses, metrics, monte_carlo, plan, report, slam
from jaxslam import logs as log_of
from jaxslam import world as worlds
from jaxslam.batches import use_cores
from jaxslam.io import checkpoint, mrclam, readers, tum
from jaxslam.io import noise as noise_file
from jaxslam.io.errors import InputError
from jaxslam.io.output import folder, write_json
from jaxslam.losses import Loss
from jaxslam.monte_carlo import Log
from jaxslam.motion import Robot
from jaxslam.options import keep_compiled, named, noise_of, stopwatch, within
from jaxslam.slam import Config, Noise
from jaxslam.world import World

NOISE, CHECKPOINT = "noise.json", "tune.npz"


class Job(NamedTuple):
    """A tuning task.

    Attributes:
        config: Configuration of the filter.
        noise: Initial noise parameters.
        train: [B] runs to tune on.
        test: [H] held-out runs to evaluate on; None: evaluate on `train`.
        title: Title of the summary.
    """

    config: Config
    noise: Noise
    train: Log
    test: Log | None
    title: str


class _Settings(NamedTuple):
    """Settings of the optimisation, as `fit.tune` takes them."""

    loss: Loss
    frozen: tuple[str, ...]
    steps: int
    batch: int | None
    seed: int
    patience: int | None


class _LogFiles(NamedTuple):
    """Logs that are read and checked, but not yet turned into runs."""

    config: Config
    noise: Noise  # initial
    train: Sequence[Any]
    test: Sequence[Any]
    to_run: Callable[[Any], Log]  # of one of `train` or `test`
    no_reference: Sequence[Path]  # paths of logs without a reference
    advice: str  # for them


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
    use_cores()
    within("--steps", steps, 1, 10**5)
    within("--seed", seed, 0, 2**32 - 1)
    within("--batch", 1 if batch is None else batch, 1, 10**6)
    within("--patience", 1 if patience is None else patience, 1, 10**6)
    if noise is not None and noise.resolve() == (out / NOISE).resolve():
        advice = "name another folder by --out"
        raise InputError("would be replaced by the result", path=noise, advice=advice)
    settings = _Settings(losses.BY_NAME[loss], freeze, steps, batch, seed, patience)
    with named("--freeze"):
        fit.free(slam.log_noise(aligned=True), freeze)
    if logs:
        make_job = _recorded(logs, test, reference, odometry == "scan", noise, settings.loss)
    else:
        if test or reference:
            raise InputError("apply to logs only", field="--test, --reference")
        within("--runs", runs, 1, 10**6)
        within("--heldout", heldout, 0, 10**6)
        make_job = _simulated(world, runs, heldout, noise, seed)
    with folder(out) as out_dir:
        keep_compiled()
        with stopwatch() as seconds:
            job = make_job()
            found = _tune(job, out, settings)
            with _resumable(out, lambda: "all evaluations"):
                numbers = _evaluate(job, found, settings)
        numbers |= {"seconds": seconds}
        noise_file.write(out_dir / NOISE, found.noise)
        write_json(out_dir / "metrics.json", numbers)
        report.draw_history(out_dir / "history.png", found)
    (out / CHECKPOINT).unlink(missing_ok=True)
    report.tell_tuning(numbers, job.title, out)


def _simulated(
    world: str, runs: int, heldout: int, noise: Path | None, seed: int
) -> Callable[[], Job]:
    """Check the options, and return a function that simulates the runs of the job."""
    with named("--world"):
        walls = World(jnp.asarray(worlds.named(world).walls, float))
        path = jnp.asarray(plan.densify(worlds.drive(world)), float)
    initial = noise_of(noise, slam.log_noise())

    def make_job() -> Job:
        config, robot = Config(), Robot()
        steps = monte_carlo.drive_steps(robot, path)
        total = runs + heldout
        print(f"simulating {total} runs of {steps} scans, world {world}", flush=True)
        logs = monte_carlo.simulate(
            jax.random.key(seed), config, walls, robot, path, runs=total, steps=steps
        )
        train = jax.tree.map(lambda leaf: np.asarray(leaf)[:runs], logs)
        test = jax.tree.map(lambda leaf: np.asarray(leaf)[runs:total], logs)
        title = f"{runs} simulated runs, world {world}"
        return Job(config, initial, train, test if heldout else None, title)

    return make_job


def _recorded(
    logs: Sequence[Path],
    test: Sequence[Path],
    reference: Sequence[Path],
    aligned: bool,
    noise: Path | None,
    loss: Loss,
) -> Callable[[], Job]:
    """Read and check all files, and return a function that turns them into the runs of the job."""
    robots = {path: _robots(path) for path in (*logs, *test)}
    is_mrclam = {found is not None for found in robots.values()}
    if len(is_mrclam) > 1:
        raise InputError("laser logs and MRCLAM data sets are tuned separately", field="LOG")
    if is_mrclam == {True}:
        if reference:
            raise InputError("MRCLAM data sets contain theirs", field="--reference")
        files = _read_mrclam(
            [robot for path in logs for robot in robots[path]],
            [robot for path in test for robot in robots[path]],
            noise,
        )
    else:
        files = _read_laser_logs(logs, test, reference, aligned, noise)
    if losses.needs_truth(loss) and files.no_reference:
        problem = f"has no reference, which the loss {_name(loss)} needs"
        raise InputError(problem, path=files.no_reference[0], advice=files.advice)

    def make_job() -> Job:
        train = [files.to_run(log) for log in files.train]
        held_out = [files.to_run(log) for log in files.test]
        count = f"{len(train)} log{'s' if len(train) > 1 else ''}"
        title = f"{count}, {sum(len(run.truth) for run in train)} steps"
        print(f"{title}; held out: {len(held_out)}", flush=True)
        held_out = log_of.stack(held_out) if held_out else None
        return Job(files.config, files.noise, log_of.stack(train), held_out, title)

    return make_job


def _read_mrclam(
    train: Sequence[tuple[Path, int]], test: Sequence[tuple[Path, int]], noise: Path | None
) -> _LogFiles:
    """Read robots (folder, number) of MRCLAM data sets."""
    initial = noise_of(noise, slam.sighting_noise())
    robots = [*train, *test]
    read = [mrclam.read(path, robot) for path, robot in robots]
    no_reference = [
        path / f"Robot{robot}"
        for (path, robot), log in zip(robots, read, strict=True)
        if not log.referenced.any()
    ]
    return _LogFiles(
        log_of.config_of(read),
        initial,
        read[: len(train)],
        read[len(train) :],
        log_of.from_sightings,
        no_reference,
        "use --loss likelihood",
    )


def _read_laser_logs(
    train: Sequence[Path],
    test: Sequence[Path],
    reference: Sequence[Path],
    aligned: bool,
    noise: Path | None,
) -> _LogFiles:
    """Read laser logs of one scanner with their reference trajectories, if there are any."""
    initial = noise_of(noise, slam.log_noise(aligned=aligned))
    paths = [*train, *test]
    read = [readers.read(path) for path in paths]
    if reference and len(reference) != len(read):
        problem = f"{len(reference)} files for {len(read)} logs"
        raise InputError(problem, field="--reference", advice="give one for each log, in order")
    references = [tum.read(path) for path in reference] or [None] * len(read)
    for path, log in zip(paths, read, strict=True):
        if log.lidar != read[0].lidar:
            problem = f"has another scanner than {paths[0]}"
            raise InputError(problem, path=path, advice="tune them separately")
    config = log_of.config_of_scans(read)
    for path, log, trajectory in zip(reference, read, references, strict=False):
        if not metrics.match_times(log.times, trajectory[0]).size:
            advice = "compare their clocks, and the order of --reference"
            raise InputError("has no pose at the time of a scan", path=path, advice=advice)

    def to_run(pair: tuple[Any, report.Trajectory | None]) -> Log:
        log, trajectory = pair
        return log_of.from_recording(log, config, trajectory, aligned=aligned)

    pairs = list(zip(read, references, strict=True))
    return _LogFiles(
        config,
        initial,
        pairs[: len(train)],
        pairs[len(train) :],
        to_run,
        [] if reference else train,
        "give --reference, or use --loss likelihood",
    )


def _name(loss: Loss) -> str:
    """Name of a loss, as --loss takes it."""
    return next(name for name, function in losses.BY_NAME.items() if function is loss)


def _robots(path: Path) -> list[tuple[Path, int]] | None:
    """Folder and number of the MRCLAM robots that a path names; None if it is no such data set."""
    if (path / "Barcodes.dat").is_file():
        return [(path, robot) for robot in mrclam.robots(path)]
    match = re.fullmatch(r"Robot(\d+)(_\w+\.dat)?", path.name)
    if match and (path.parent / "Barcodes.dat").is_file():
        return [(path.parent, int(match[1]))]
    return None


def _tune(job: Job, out: Path, settings: _Settings) -> fit.Fit:
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
    file, state, steps = out / CHECKPOINT, None, settings.steps
    whole = settings.batch is None or settings.batch >= len(job.train.motion)
    if file.exists():
        optimiser = descent.usual(steps, whole=whole)
        template = fit.begin(job.noise, steps=steps, frozen=settings.frozen, optimiser=optimiser)
        state = checkpoint.read(file, template, about)
        print(f"resuming after evaluation {int(state.step)} of {steps + 1}", flush=True)
    done = 0 if state is None else int(state.step)
    bar = tqdm(total=steps + 1, initial=done, desc="compiling", mininterval=0)

    def save(state: fit.State) -> None:
        nonlocal done
        done = int(state.step)
        out.mkdir(parents=True, exist_ok=True)
        noise_file.write(out / NOISE, fit.result(state, job.noise, whole=whole).noise)
        checkpoint.write(file, state, about)
        heldout = state.heldout[np.isfinite(state.heldout)]
        postfix = {"loss": f"{state.loss[done - 1]:.4g}"}
        postfix |= {"heldout": f"{heldout[-1]:.4g}"} if heldout.size else {}
        bar.set_description("tuning", refresh=False)
        bar.set_postfix(postfix, refresh=False)
        bar.update(done - bar.n)

    with _resumable(out, lambda: done and f"{done} of {steps + 1} evaluations"), bar:
        return fit.tune(
            job.noise,
            job.config,
            job.train,
            loss=settings.loss,
            steps=steps,
            batch=settings.batch,
            seed=settings.seed,
            frozen=settings.frozen,
            heldout=job.test,
            patience=settings.patience,
            state=state,
            report=save,
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
            f"interrupted after {done()}; {out / NOISE} holds the best parameters so far, and the "
            "same command resumes"
        ) from None


def _evaluate(job: Job, found: fit.Fit, settings: _Settings) -> report.Numbers:
    """Errors before and after the tuning, and standard errors of the parameters."""
    runs = job.train if job.test is None else job.test

    def errors(noise: Noise) -> report.Numbers:
        loss = fit.values(noise, job.config, runs, settings.loss)
        numbers = {"loss": float(np.mean(loss[np.isfinite(loss)]))}
        if runs.judged is None or runs.judged.any():
            numbers |= monte_carlo.evaluate(monte_carlo.tracks(job.config, noise, runs))
        return numbers

    print("evaluating errors before and after, and standard errors ...", flush=True)
    numbers = errors(found.noise) | {
        "judged_on": "the runs it was tuned on" if job.test is None else "held-out runs",
        "before": errors(job.noise) | {"noise": job.noise},
        "evaluations": len(found.loss),
        "best": found.best,
        "skipped": int(found.skipped.sum()),
        "noise": found.noise,
        "standard_errors": None,
        "warnings": ["no standard errors: they need two runs at least"],
    }
    if len(job.train.motion) >= 2:
        standard_errors = curvature.standard_errors(
            found.noise, job.config, job.train, loss=settings.loss, frozen=settings.frozen
        )
        relative = dict(zip(standard_errors.names, standard_errors.relative, strict=True))
        numbers |= {"standard_errors": relative, "warnings": list(standard_errors.warnings)}
    return numbers


def _hash(logs: Log | None) -> str:
    """Hash of the content of logs."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(logs):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:16]
