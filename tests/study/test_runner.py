"""Trials of a study: the same after a stop, paired over variants, refused if of something else."""

from typing import NamedTuple

import jax
import numpy as np
import pytest

from jaxslam import NoiseParams
from jaxslam.io.errors import InputError
from jaxslam.pipeline.episodes import EPISODE_BATCH
from jaxslam.simulation import Robot, World, life_in
from jaxslam.study import kept_trials, runner
from jaxslam.study.runner import run
from tests import short_trials
from tests.short_trials import CONFIG, PATH, STEPS


def variant(name="a", **changes):
    return short_trials.variant()._replace(name=name, **changes)


@pytest.fixture
def small_files(monkeypatch):
    monkeypatch.setattr(kept_trials, "TRIALS_PER_FILE", 4)


class Stop(Exception):
    pass


def stop_after(variant_number, done):
    def callback(progress):
        if (progress.variant, progress.done) >= (variant_number, done):
            raise Stop

    return callback


def assert_same(first, second):
    for one, other in zip(first, second, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_study_that_is_stopped_ends_with_the_same_outcomes(tmp_path, small_files):
    both = [variant(), variant("b", params=NoiseParams.for_simulated_robot(0.4, 0.01))]
    whole = run(both, num_trials=10, seed=3)
    assert len(whole[0].finite) == 10 and whole[0].error.shape == (10, STEPS)
    with pytest.raises(Stop):
        run(both, num_trials=10, seed=3, folder=tmp_path, callback=stop_after(1, 4))
    seen = []
    found = run(both, num_trials=10, seed=3, folder=tmp_path, callback=seen.append)
    assert_same(found, whole)
    assert seen[0] == (0, 10, 10) and seen[-1] == (1, 10, 20)
    assert {one.variant for one in seen[1:]} == {1}  # the first was done
    assert_same(run(both, num_trials=10, seed=3, folder=tmp_path), whole)
    np.testing.assert_array_equal(whole[0].place, whole[1].place)  # the same drives
    assert np.any(whole[0].error != whole[1].error)


def test_variants_of_one_program_run_one_after_the_other(monkeypatch, tmp_path):
    """A process keeps only some programs, and each is compiled, and warmed up, once."""

    def collect(results, kind, num_trials, *, folder, warm_up, callback, **_):
        callback(num_trials)
        return folder.name, warm_up

    monkeypatch.setattr(kept_trials, "collect", collect)
    given, seen = [variant(num_scans=4 + k % 2) for k in range(5)], []
    found = runner.run_timed(given, num_trials=7, seed=0, folder=tmp_path, callback=seen.append)
    assert found == [(f"{k:03d}", k < 2) for k in range(5)]
    assert [one.variant for one in seen] == [0, 2, 4, 1, 3]
    assert [one.done_of_all for one in seen] == [7, 14, 21, 28, 35]


def test_trials_of_something_else_are_refused(tmp_path, small_files):
    run([variant()], num_trials=4, seed=3, folder=tmp_path)
    with pytest.raises(InputError, match="0000000.npz: has trials of another variant, seed"):
        run([variant()], num_trials=4, seed=4, folder=tmp_path)
    other = variant(robot=Robot(encoder_noise=0.01))
    with pytest.raises(InputError, match="remove it, or name another folder"):
        run([other], num_trials=4, seed=3, folder=tmp_path)
    (file,) = tmp_path.glob("000/*.npz")
    file.write_bytes(b"PK")
    with pytest.raises(InputError, match="is broken"):
        run([variant()], num_trials=4, seed=3, folder=tmp_path)
    assert runner.fingerprint(variant("other name"), 3) == runner.fingerprint(variant(), 3)


def test_fingerprints_differ_for_all_that_matters():
    living = life_in(variant().world, PATH, max_people=2)
    more = living._replace(traffic=living.traffic._replace(people=np.float32(1.0)))
    walls = np.asarray(variant().world.walls)
    cases = [
        variant(),
        variant(num_scans=STEPS + 1),
        variant(config=CONFIG._replace(filter=CONFIG.filter._replace(max_landmarks=8))),
        variant(params=NoiseParams.for_simulated_robot(0.4, 0.02)),
        variant(world=World(walls + 1e-9)),
        variant(path=PATH + 1e-9),
        variant(robot=Robot(encoder_noise=0.1)),
        variant(life=living),
        variant(life=more),
    ]
    marks = {runner.fingerprint(one, 3) for one in cases}
    assert len(marks | {runner.fingerprint(variant(), 4)}) == len(cases) + 1
    # Numbers that are traced need no program of their own.
    programs = [runner.program_of(one) for one in cases]
    assert programs[0] == programs[3] == programs[4] == programs[5]
    assert programs[7] == programs[8] and len(set(programs)) == 5
    assert runner.fingerprint(runner.in_numpy(cases[7]), 3) == runner.fingerprint(cases[7], 3)


class Numbers(NamedTuple):
    trial: np.ndarray


@pytest.mark.parametrize("num_trials", [3, 50])
def test_what_is_timed_has_the_shapes_of_what_was_computed_before(num_trials):
    """Whatever is compiled for the first results of each size is compiled in the warm-up."""
    per_round = EPISODE_BATCH.on("cpu") * jax.device_count()
    sizes = []

    def results(total, first):
        for start in range(first, total, per_round):
            sizes.append(min(per_round, total - start))
            yield Numbers(np.arange(start, start + sizes[-1]))

    found = kept_trials.collect(results, Numbers, num_trials, folder=None, mark="")
    np.testing.assert_array_equal(found.record.trial, np.arange(num_trials))
    assert sizes[0] == sizes[1] == min(num_trials, per_round)
    again = len(sizes)
    kept_trials.collect(results, Numbers, num_trials, folder=None, mark="", warm_up=False)
    assert len(sizes) - again == again - 1
