"""The command `jaxslam study FILE`."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from tqdm import tqdm

from jaxslam.cli.options import OutFolder
from jaxslam.cli.study_variants import prepare
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.io.output import folder, write_json
from jaxslam.pipeline.episodes import EPISODE_BATCH
from jaxslam.study import outcomes as outcomes_module
from jaxslam.study import runner, study_file
from jaxslam.study.outcomes import Outcomes
from jaxslam.study.runner import Progress, Variant
from jaxslam.study.study_file import StudyFile

PARTS = "study_parts"  # folder of finished trials
CELL = 0.5  # [m] side of the squares of the map of failures
BYTES_PER_SCAN = 12  # that are kept of a trial


def study(
    study_toml: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")],
    dry_run: bool = False,
    out: OutFolder = Path("out"),
) -> None:
    """Compare variants of a robot, its building and its filter over many simulated trials.

    Writes study.json, of all variants, and study.png: how often they succeed, with intervals, how
    large errors are, when and where trials fail. Trial i of all variants has the same random
    numbers. The same command resumes where it was stopped.

    Args:
        study_toml: The study, TOML or JSON; `jaxslam.study.study_file` documents it.
        dry_run: Read everything, run a few trials, and print what the study takes; write nothing.
        out: Folder for the results, and for finished trials until all are done.
    """
    use_cpu_devices()
    given = study_file.read(study_toml)
    prepared = prepare(given)
    scans = sum(one.num_scans for one in prepared.variants) * given.num_trials
    for note in prepared.notes:
        print(f"note: {note}", flush=True)
    print(
        f"{study_toml}: {len(prepared.variants)} variants of {given.num_trials} trials, "
        f"{scans} scans",
        flush=True,
    )
    enable_caches()
    if dry_run:
        _print_costs(given, prepared.variants, scans)
        return
    begin = perf_counter()
    found = _run(given, prepared.variants, out / PARTS)
    numbers = _numbers(given, prepared.variants, found) | {"seconds": perf_counter() - begin}
    with folder(out) as out_dir:
        write_json(out_dir / "study.json", numbers)
        _draw(out_dir / "study.png", prepared.variants, found, numbers)
    shutil.rmtree(out / PARTS, ignore_errors=True)
    _print_table(numbers)
    print(f"wrote {out / 'study.json'} and study.png")


def _run(given: StudyFile, variants: Sequence[Variant], parts: Path) -> list[Outcomes]:
    """Outcomes of all trials, with a progress bar."""
    with tqdm(
        total=len(variants) * given.num_trials, unit="trial", desc="compiling", mininterval=0.5
    ) as bar:

        def show(progress: Progress) -> None:
            bar.set_description(variants[progress.variant].name[:30], refresh=False)
            bar.update(progress.variant * given.num_trials + progress.done - bar.n)

        return runner.run(
            variants, num_trials=given.num_trials, seed=given.seed, folder=parts, callback=show
        )


def _numbers(
    given: StudyFile, variants: Sequence[Variant], found: Sequence[Outcomes]
) -> dict[str, Any]:
    """Content of study.json."""
    rows = []
    for variant, own in zip(variants, found, strict=True):
        limit = given.success_distance
        row = {"name": variant.name, "settings": dict(variant.settings)}
        row |= outcomes_module.summarise(
            own, success_distance=limit, scan_period=variant.robot.scan_period
        )
        row["places"] = outcomes_module.failures_by_place(own, success_distance=limit, cell=CELL)
        if own is not found[0]:
            row["against_first"] = outcomes_module.compare(found[0], own, success_distance=limit)
        rows.append(row)
    return {
        "trials": given.num_trials,
        "seed": given.seed,
        "success_m": given.success_distance,
        "variants": rows,
    }


def _print_costs(given: StudyFile, variants: Sequence[Variant], scans: int) -> None:
    """Time and memory of a study, by a few trials of its first variant."""
    first = variants[0]
    count = EPISODE_BATCH * jax.device_count()
    taken = []
    for seed in (given.seed, given.seed + 1):  # compiles at the first
        begin = perf_counter()
        runner.run([first], num_trials=count, seed=seed)
        taken.append(perf_counter() - begin)
    programs = len({(one.config, one.robot, one.num_scans) for one in variants})
    expected = taken[1] * scans / (count * first.num_scans) + programs * (taken[0] - taken[1])
    kept = BYTES_PER_SCAN * scans / 2**20
    print(
        f"about {expected / 60:.1f} minutes on {jax.device_count()} devices, by {count} trials of "
        f"the first variant; {programs} programs to compile; {kept:.0f} MB of outcomes"
    )


def _draw(
    path: Path, variants: Sequence[Variant], found: Sequence[Outcomes], numbers: dict[str, Any]
) -> None:
    """Draw the page, with the map of the variant that fails most."""
    # Imported here, because matplotlib is slow to import.
    from jaxslam.viz import canvas
    from jaxslam.viz.study_page import StudyPage, study_page

    rows = numbers["variants"]
    worst = min(range(len(rows)), key=lambda k: rows[k]["success"]["value"])
    page = StudyPage(
        [one.name for one in variants],
        rows,
        np.asarray(variants[worst].world.walls),
        worst,
        rows[worst]["places"],
        max(one.num_scans * one.robot.scan_period for one in variants),
    )
    canvas.save(study_page(page), path)


def _print_table(numbers: dict[str, Any]) -> None:
    """Print a line for each variant."""
    print("success [95 %]            RMSE p50    p90 [m]   NEES   variant")
    for row in numbers["variants"]:
        own, rmse, nees = row["success"], row["position_rmse_m"], row["nees"]
        share = f"{own['value']:6.1%} [{own['low']:6.1%}, {own['high']:6.1%}]"
        middle, high = (
            "   inf" if rmse[k]["value"] is None else f"{rmse[k]['value']:6.3f}"
            for k in ("p50", "p90")
        )
        mean = "    -" if nees is None else f"{nees['mean']:5.2f}"
        print(f"{share}   {middle}   {high}   {mean}   {row['name']}")
