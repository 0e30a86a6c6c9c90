"""The progress bar of a study counts the trials of all variants."""

import io

import pytest

from jaxslam.study import progress, runner
from jaxslam.study.runner import Progress, Variant

VARIANTS = [Variant(name, {}, *[None] * 6) for name in ("first", "second " + "x" * 60)]


@pytest.mark.parametrize("resumed", [0, 3])
def test_the_bar_goes_over_the_trials_of_all_variants(monkeypatch, tmp_path, resumed):
    given = {}

    def made_up(variants, callback, **others):
        given.update(others, variants=variants)
        for number in range(len(variants)):
            for done in range(resumed, 5):
                callback(Progress(number, done, 4 * number + done))
        callback(Progress(1, 4, 8))
        return ["found"]

    monkeypatch.setattr(runner, "run_timed", made_up)
    monkeypatch.setattr(progress.tqdm, "monitor_interval", 0)
    stream = io.StringIO()
    own = {"num_trials": 4, "seed": 7, "folder": tmp_path}
    assert progress.run_shown(VARIANTS, **own, stream=stream) == ["found"]
    assert given == {"variants": VARIANTS, **own}
    last = stream.getvalue().rstrip().split("\r")[-1]
    assert "8/8" in last and last.startswith("second xxx") and "x" * 40 not in last
    assert "compiling" in stream.getvalue()
