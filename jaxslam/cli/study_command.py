"""The command `jaxslam study FILE`."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, TextIO

import jax
import numpy as np
import tyro

from jaxslam.cli.options import OutFolder, check_range
from jaxslam.cli.study_variants import prepare
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import MAX_PROGRAMS, use_cpu_devices
from jaxslam.core.memory import memory_now, peak_memory, release_memory
from jaxslam.core.types import Metrics
from jaxslam.io.errors import InputError
from jaxslam.io.output import folder, write_json, write_text
from jaxslam.pipeline.episodes import EPISODE_BATCH
from jaxslam.study import processes as processes_module
from jaxslam.study import reporting, runner, study_file
from jaxslam.study.kept_trials import Collected
from jaxslam.study.processes import Group, LostProcessError
from jaxslam.study.progress import run_shown
from jaxslam.study.runner import Variant
from jaxslam.study.wording import findings

PARTS = "study_parts"  # folder of finished trials
BYTES_PER_SCAN = 12  # that are kept of a trial
MAX_MAPS = 12  # variants whose failures are mapped
FLAGS = "--coordinator-address", "--num-processes", "--process-id"

Address = Annotated[str, tyro.conf.arg(metavar="HOST:PORT", help_behavior_hint="")]
"""Option that names a machine and its port, or none."""


def study(
    study_toml: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")],
    dry_run: bool = False,
    processes: int = 1,
    coordinator_address: Address = "",
    num_processes: int = 0,
    process_id: int = -1,
    out: OutFolder = Path("out"),
) -> None:
    """Compare variants of a robot, its building and its filter over many simulated trials.

    Writes report.html, a page with findings in words, table and pictures, study.json, the numbers
    of it, study.png, and trials.csv, a line for each trial. Trial i of all variants has the same
    random numbers. The same command resumes where it was stopped, bit for bit.

    Args:
        study_toml: The study, TOML or JSON; `jaxslam.study.study_file` documents it.
        dry_run: Read everything, run a few trials of the first variant, and print the time and
            memory that the study takes by these; write nothing.
        processes: Processes of this machine that share the work.
        coordinator_address: HOST:PORT of process 0 where several machines share it: start one
            process on each, with the same file and options.
        num_processes: On how many machines.
        process_id: Which of them this is, from 0; process 0 writes the results.
        out: Folder for the results, and for finished trials until all are done.
    """
    check_range("--processes", processes, 1, 256)
    given = processes, coordinator_address, num_processes, process_id
    group = processes_module.group_of(*given, names=FLAGS)
    if group is None or dry_run:
        use_cpu_devices()
    asked = study_file.read(study_toml)
    prepared = prepare(asked)
    scans = sum(one.num_scans for one in prepared.variants) * asked.num_trials
    for note in prepared.notes:
        print(f"note: {note}", flush=True)
    count = len(prepared.variants)
    print(
        f"{study_toml}: {count} variant{'s' if count > 1 else ''} of {asked.num_trials} trials, "
        f"{scans} scans",
        flush=True,
    )
    enable_caches()
    about = prepared.variants, asked.num_trials, asked.seed
    if dry_run:
        _print_costs(prepared.variants, asked.seed, scans)
        return
    found = _run(*about, out / PARTS, group)
    if found is None:
        print("done; process 0 has the results")
        return
    numbers = reporting.report(
        prepared.variants, found, seed=asked.seed, success_distance=asked.success_distance
    )
    said = findings(numbers)
    with folder(out) as out_dir:
        write_json(out_dir / "study.json", numbers | {"findings": said})
        table = reporting.table_of_trials(
            prepared.variants, found, success_distance=asked.success_distance
        )
        write_text(out_dir / "trials.csv", table)
        _draw(out_dir, study_toml.stem, prepared.variants, numbers, said, prepared.notes)
    shutil.rmtree(out / PARTS, ignore_errors=True)
    _print_table(numbers)
    for text in said:
        print(f"- {text}")
    print(f"wrote {out / 'report.html'}, study.json, study.png and trials.csv")


def _run(
    variants: Sequence[Variant], num_trials: int, seed: int, parts: Path, group: Group | None
) -> list[Collected] | None:
    """All trials, with a progress bar; None where process 0 is not one of this machine."""
    if group is None:
        return run_shown(variants, num_trials=num_trials, seed=seed, folder=parts)
    given = [runner.in_numpy(one) for one in variants], num_trials, seed, parts
    try:
        peaks = processes_module.run_group(group, _share, *given)
    except LostProcessError as error:
        raise InputError(str(error)) from None
    if 0 not in group.own:
        return None
    # What the processes have kept:
    found = run_shown(variants, num_trials=num_trials, seed=seed, folder=parts)
    # The memory of all processes of this machine counts.
    return [one._replace(peak_mb=max(one.peak_mb, sum(peaks))) for one in found]


def _share(
    variants: Sequence[Variant], num_trials: int, seed: int, parts: Path, stream: TextIO
) -> float:
    """Work of one of several processes: process 0 keeps the trials; its most memory [MB]."""
    enable_caches()
    run_shown(variants, num_trials=num_trials, seed=seed, folder=parts, stream=stream)
    return peak_memory()


def _print_costs(variants: Sequence[Variant], seed: int, scans: int) -> None:
    """Time and memory of a study, measured on a few trials of its first variant."""
    first, before = variants[0], memory_now()
    count = EPISODE_BATCH.on(jax.default_backend()) * jax.device_count()
    begin = perf_counter()
    (probe,) = runner.run_timed([first], num_trials=count, seed=seed)
    # The first trials are computed twice, once to compile.
    compiling = max(perf_counter() - begin - 2 * probe.seconds, 0.0)
    release_memory()
    programs = len({runner.program_of(one) for one in variants})
    per_scan = probe.seconds / (count * first.num_scans)
    expected = per_scan * scans + programs * compiling
    kept = BYTES_PER_SCAN * scans / 2**20
    held = min(programs, MAX_PROGRAMS) - 1
    most = peak_memory() + held * max(memory_now() - before, 0.0)
    most += kept * (1 + 1 / len(variants))
    print(
        f"about {expected / 60:.1f} minutes on {jax.device_count()} devices: {per_scan * 1e3:.2f} "
        f"ms a scan, and {compiling:.0f} s to compile each of {programs} programs, or less where "
        f"they are kept; about {most:.0f} MB of memory, "
        f"{kept:.0f} MB of it outcomes; measured on {count} trials of {first.name!r}"
    )


def _draw(
    out: Path,
    title: str,
    variants: Sequence[Variant],
    numbers: Metrics,
    said: Sequence[str],
    notes: Sequence[str],
) -> None:
    """Draw study.png, with the map of the variant that fails most, and write report.html."""
    # Imported here, because matplotlib is slow to import.
    from jaxslam.viz import canvas, study_page, study_report

    rows = numbers["variants"]
    by_failures = sorted(range(len(rows)), key=lambda k: rows[k]["success"]["value"])
    page = study_page.StudyPage(
        rows,
        [np.asarray(one.world.walls) for one in variants],
        by_failures[0],
        max(one.num_scans * one.robot.scan_period for one in variants),
    )
    overview = study_page.study_page(page)
    canvas.save(overview, out / "study.png")
    pictures: list[tuple[str, Any]] = [("Success, errors, time to failure", overview)]
    costs = study_page.cost_picture(rows)
    if costs is not None:
        pictures.append(("Success against cost", costs))
    mapped = by_failures[:MAX_MAPS]
    heading = "Where trials fail"
    heading += f", of the {MAX_MAPS} variants that fail most" if len(rows) > MAX_MAPS else ""
    pictures.append((heading, study_page.maps_picture(page, mapped)))
    text = study_report.study_html(title, numbers, said, notes, pictures)
    write_text(out / "report.html", text)


def _print_table(numbers: Metrics) -> None:
    """Print a line for each variant."""
    rows = numbers["variants"]
    has_cost = all("cost" in row for row in rows)
    cost = "      cost" if has_cost else ""
    print(f"success [95 %]            RMSE p50    p90 [m]   NEES{cost}   s/trial   variant")
    for row in rows:
        own, rmse, nees = row["success"], row["position_rmse_m"], row["nees"]
        share = f"{own['value']:6.1%} [{own['low']:6.1%}, {own['high']:6.1%}]"
        middle, high = (
            "   inf" if rmse[k]["value"] is None else f"{rmse[k]['value']:6.3f}"
            for k in ("p50", "p90")
        )
        mean = "    -" if nees is None else f"{nees['mean']:5.2f}"
        cost = f"{row['cost']:10g}" if has_cost else ""
        seconds = f"{row['seconds_per_trial']:7.2g}"
        print(f"{share}   {middle}   {high}   {mean}{cost}   {seconds}   {row['name']}")
