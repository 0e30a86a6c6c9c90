"""Trials of all variants, with a progress bar."""

from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from tqdm import tqdm

from jaxslam.study import runner
from jaxslam.study.kept_trials import Collected
from jaxslam.study.runner import Progress, Variant

MAX_NAME = 30  # letters of a variant's name that the bar shows


def run_shown(
    variants: Sequence[Variant],
    *,
    num_trials: int,
    seed: int,
    folder: Path | None = None,
    stream: TextIO | None = None,
) -> list[Collected]:
    """As `runner.run_timed`, with a progress bar on `stream`; None: standard error."""
    total = len(variants) * num_trials
    with tqdm(total=total, unit="trial", desc="compiling", mininterval=0.5, file=stream) as bar:

        def show(progress: Progress) -> None:
            bar.set_description(variants[progress.variant].name[:MAX_NAME], refresh=False)
            bar.update(progress.done_of_all - bar.n)

        return runner.run_timed(
            variants, num_trials=num_trials, seed=seed, folder=folder, callback=show
        )
