"""The command `jaxslam tune`: noise fitted to simulated drives or to recorded logs."""

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
    """What is tuned, and on what."""

    config: Config
    noise: Noise  # to start from
    train: Log  # [B]
    test: Log | None  # [H]
    title: str


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
    """Fit the noise that the filter assumes, on recorded logs or on simulated drives.

    Writes noise.json, which --noise of the other commands reads, metrics.json with the errors
    before and after and the standard errors of the parameters, and history.png. When it is
    stopped, noise.json holds the best so far, and the same command goes on from there.

    Tuned are the odometry's four coefficients, the sensor's range, bearing, scale and wall, and
    how far aligned scans are trusted (alignment), by gradient. What decides which feature is which
    landmark, such as the gate, is not smooth and is not tuned.

    Args:
        logs: Logs of laser scans, as `jaxslam run` takes them, or folders of MRCLAM data sets
            (FOLDER for all of its robots, FOLDER/Robot2 for one); none: simulated drives.
        test: Logs to judge by, which nothing is tuned on.
        reference: A TUM file for each log of scans, first of those to tune on, then of --test;
            MRCLAM data sets bring their own.
        odometry: Of logs of scans: scans aligned and fused with the wheels, or the wheels alone.
        world: Where simulated drives are.
        runs: Simulated drives to tune on.
        heldout: And to judge by.
        loss: What is to be small: calibrated, localisation with a covariance that fits its errors;
            localisation alone, which leaves the size of the noise open; or the (negative)
            likelihood of what was observed, the only one that needs no reference.
        steps: Updates: of L-BFGS, or of Adam with --batch.
        batch: Drives that each step sees, in turn; by default all.
        patience: Stop after as many judgements without a better one; by default never.
        freeze: Parameters that stay: odometry, odometry[0] ... odometry[3], range, bearing, scale,
            wall, alignment.
        noise: File of the noise to start from; by default a cautious one.
        seed: Of the simulated drives and of the order of batches.
        out: Folder for the results.
    """
    use_cores()
    within("--steps", steps, 1, 10**5)
    within("--seed", seed, 0, 2**32 - 1)
    within("--batch", 1 if batch is None else batch, 1, 10**6)
    within("--patience", 1 if patience is None else patience, 1, 10**6)
    if noise is not None and noise.resolve() == (out / NOISE).resolve():
        advice = "name another folder by --out"
        raise InputError("would be replaced by what is found", path=noise, advice=advice)
    chosen = losses.BY_NAME[loss]
    with named("--freeze"):
        fit.free(slam.log_noise(aligned=True), freeze)
    if logs:
        make = _recorded(logs, test, reference, odometry == "scan", noise, chosen)
    else:
        if test or reference:
            raise InputError("go with recorded logs", field="--test, --reference")
        within("--runs", runs, 1, 10**6)
        within("--heldout", heldout, 0, 10**6)
        make = _simulated(world, runs, heldout, noise, seed)
    with folder(out) as place:
        keep_compiled()
        with stopwatch() as seconds:
            job = make()
            options = {"loss": chosen, "frozen": freeze}
            how = {"steps": steps, "batch": batch, "seed": seed, "patience": patience}
            found = _descend(job, out, options, **how)
            with _stoppable(out, lambda: "all evaluations"):
                numbers = _judge(job, found, options)
        numbers |= {"seconds": seconds}
        noise_file.write(place / NOISE, found.noise)
        write_json(place / "metrics.json", numbers)
        report.draw_history(place / "history.png", found)
    (out / CHECKPOINT).unlink(missing_ok=True)
    report.tell_tuning(numbers, job.title, out)


def _simulated(world: str, runs: int, heldout: int, noise: Path | None, seed: int) -> Any:
    """What makes the job of simulated drives, after all that was asked for is checked."""
    with named("--world"):
        known = World(jnp.asarray(worlds.named(world).walls, float))
        path = jnp.asarray(plan.densify(worlds.drive(world)), float)
    start = noise_of(noise, slam.log_noise())

    def make() -> Job:
        config, robot = Config(), Robot()
        steps = monte_carlo.drive_steps(robot, path)
        total = runs + heldout
        print(f"simulating {total} drives of {steps} scans, world {world}", flush=True)
        logs = monte_carlo.simulate(
            jax.random.key(seed), config, known, robot, path, runs=total, steps=steps
        )
        train, test = (
            jax.tree.map(lambda x: np.asarray(x)[part], logs)  # noqa: B023
            for part in (slice(runs), slice(runs, total))
        )
        title = f"{runs} drives in world {world}"
        return Job(config, start, train, test if heldout else None, title)

    return make


def _recorded(
    logs: Sequence[Path],
    test: Sequence[Path],
    reference: Sequence[Path],
    aligned: bool,
    noise: Path | None,
    loss: Loss,
) -> Any:
    """What makes the job of recorded logs, after all files are read and checked."""
    groups = [[_robots(path) for path in some] for some in (logs, test)]
    named_ones = {found is not None for some in groups for found in some}
    if len(named_ones) > 1:
        raise InputError("logs of scans and MRCLAM data sets are tuned apart", field="LOG")
    if named_ones == {True}:
        if reference:
            raise InputError("MRCLAM data sets bring their own", field="--reference")
        start = noise_of(noise, slam.sighting_noise())
        robots = [[one for found in some for one in found] for some in groups]
        parts = [[mrclam.read(*one) for one in some] for some in robots]
        every = parts[0] + parts[1]
        config = log_of.config_of(every)
        read = log_of.from_sightings
        blind = [
            folder / f"Robot{robot}"
            for (folder, robot), one in zip(robots[0] + robots[1], every, strict=True)
            if not one.referenced.any()
        ]
        advice = "use --loss likelihood"
    else:
        start = noise_of(noise, slam.log_noise(aligned=aligned))
        every = [readers.read(path) for path in (*logs, *test)]
        if reference and len(reference) != len(every):
            problem = f"{len(reference)} files for {len(every)} logs"
            raise InputError(problem, field="--reference", advice="give one for each log, in order")
        known = [tum.read(path) for path in reference] or [None] * len(every)
        other = [i for i, one in enumerate(every) if one.lidar != every[0].lidar]
        if other:
            problem = f"has another scanner than {logs[0]}"
            raise InputError(problem, path=(*logs, *test)[other[0]], advice="tune them apart")
        config = log_of.config_of_scans(every)
        pairs = list(zip(every, known, strict=True))
        for path, (one, poses) in zip(reference, pairs, strict=False):
            if not metrics.match_times(one.times, poses[0]).size:
                advice = "compare their clocks, and the order of --reference"
                raise InputError("has no pose at the time of a scan", path=path, advice=advice)
        parts = pairs[: len(logs)], pairs[len(logs) :]
        read = lambda pair: log_of.from_recording(pair[0], config, pair[1], aligned=aligned)
        blind = [] if reference else logs
        advice = "give --reference, or use --loss likelihood"
    if losses.needs_truth(loss) and blind:
        problem = f"has no reference, which the loss {loss.__name__} needs"
        raise InputError(problem, path=blind[0], advice=advice)

    def make() -> Job:
        train, tests = ([read(one) for one in some] for some in parts)
        drives = f"{len(train)} recorded drive{'s' if len(train) > 1 else ''}"
        title = f"{drives}, {sum(len(one.truth) for one in train)} steps"
        print(f"{title}; held out: {len(tests)}", flush=True)
        heldout = log_of.stack(tests) if tests else None
        return Job(config, start, log_of.stack(train), heldout, title)

    return make


def _robots(path: Path) -> list[tuple[Path, int]] | None:
    """Folder and number of the robots of an MRCLAM data set that a path means; None: no such."""
    if (path / "Barcodes.dat").is_file():
        return [(path, robot) for robot in mrclam.robots(path)]
    one = re.fullmatch(r"Robot(\d+)(_\w+\.dat)?", path.name)
    if one and (path.parent / "Barcodes.dat").is_file():
        return [(path.parent, int(one[1]))]
    return None


def _descend(job: Job, out: Path, options: dict[str, Any], **how: int | None) -> fit.Fit:
    """Tune, from where the last call stopped; keep where it stands after each evaluation."""
    about = {
        "config": repr(job.config),
        "loss": options["loss"].__name__,
        "frozen": sorted(options["frozen"]),
        **how,
        "noise to start from": job.noise,
        "runs": _hash(job.train),
        "heldout": _hash(job.test),
    }
    file, state, steps, batch = out / CHECKPOINT, None, how["steps"], how["batch"]
    whole = batch is None or batch >= len(job.train.motion)
    if file.exists():
        optimiser = descent.usual(steps, whole=whole)
        frozen = options["frozen"]
        begun = fit.begin(job.noise, steps=steps, frozen=frozen, optimiser=optimiser)
        state = checkpoint.read(file, begun, about)
        print(f"going on after evaluation {int(state.step)} of {steps + 1}", flush=True)
    done = 0 if state is None else int(state.step)
    bar = tqdm(total=steps + 1, initial=done, desc="compiling", mininterval=0)

    def keep(state: fit.State) -> None:
        nonlocal done
        done = int(state.step)
        out.mkdir(parents=True, exist_ok=True)
        noise_file.write(out / NOISE, fit.result(state, job.noise, whole=whole).noise)
        checkpoint.write(file, state, about)
        judged = state.heldout[np.isfinite(state.heldout)]
        shown = {"loss": f"{state.loss[done - 1]:.4g}"}
        shown |= {"heldout": f"{judged[-1]:.4g}"} if judged.size else {}
        bar.set_description("tuning", refresh=False)
        bar.set_postfix(shown, refresh=False)
        bar.update(done - bar.n)

    given = {"heldout": job.test, "state": state, "report": keep, **how, **options}
    with _stoppable(out, lambda: done and f"{done} of {steps + 1} evaluations"), bar:
        return fit.tune(job.noise, job.config, job.train, **given)


@contextmanager
def _stoppable(out: Path, done: Callable[[], str | int]) -> Iterator[None]:
    """Say of a Ctrl-C in the block how to go on, if anything is done."""
    try:
        yield
    except KeyboardInterrupt:
        if not done():
            raise
        raise KeyboardInterrupt(
            f"interrupted after {done()}; {out / NOISE} holds the best so far, and the "
            "same command goes on from here"
        ) from None


def _judge(job: Job, found: fit.Fit, options: dict[str, Any]) -> report.Numbers:
    """Numbers of a fit: errors before and after, and how sure it is of its parameters."""
    runs = job.train if job.test is None else job.test

    def errors(noise: Noise) -> report.Numbers:
        loss = fit.values(noise, job.config, runs, options["loss"])
        numbers = {"loss": float(np.mean(loss[np.isfinite(loss)]))}
        if runs.judged is None or runs.judged.any():
            numbers |= monte_carlo.evaluate(monte_carlo.tracks(job.config, noise, runs))
        return numbers

    print("errors before and after, standard errors of the parameters ...", flush=True)
    numbers = errors(found.noise) | {
        "judged_on": "the runs it was tuned on" if job.test is None else "held-out runs",
        "before": errors(job.noise) | {"noise": job.noise},
        "evaluations": len(found.loss),
        "best": found.best,
        "skipped": int(found.skipped.sum()),
        "noise": found.noise,
        "standard_errors": None,
        "warnings": ["one drive alone tells no standard errors"],
    }
    if len(job.train.motion) >= 2:
        sure = curvature.standard_errors(found.noise, job.config, job.train, **options)
        relative = dict(zip(sure.names, sure.relative, strict=True))
        numbers |= {"standard_errors": relative, "warnings": list(sure.warnings)}
    return numbers


def _hash(logs: Log | None) -> str:
    """What tells logs from others."""
    total = hashlib.sha256()
    for leaf in jax.tree.leaves(logs):
        total.update(np.ascontiguousarray(leaf).tobytes())
    return total.hexdigest()[:16]
