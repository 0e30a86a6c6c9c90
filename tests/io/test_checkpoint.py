import io
import os
import pickle
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import checkpoint
from jaxslam.io.errors import InputError
from jaxslam.tuning import fitting, optimizers
from jaxslam.tuning.optimizers import BacktrackState

ABOUT = {
    "steps": 3,
    "seed": None,
    "rate": 0.1,
    "frozen": ["range"],
    "noise": NoiseParams.for_laser_log(),
}


class Inner(NamedTuple):
    count: np.ndarray
    more: dict


class Outer(NamedTuple):
    numbers: np.ndarray
    inner: Inner
    nothing: None
    pair: tuple


def state(seed=0):
    """Nested records with numbers of many types, among them those that text would not keep."""
    rng = np.random.default_rng(seed)
    odd = np.array([np.nan, np.inf, -0.0, 5e-324, 0.1, np.nextafter(1.0, 2.0)])
    return Outer(
        rng.normal(size=(3, 4)),
        Inner(np.int64(2**62 + 1), {"b": odd, "a": rng.normal(size=5).astype(np.float32)}),
        None,
        (np.zeros((0, 3)), jnp.arange(4, dtype=jnp.int32), np.array([True, False]), np.uint8(255)),
    )


def check_equal(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        b = np.asarray(b)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())


def complaint(path, template=None, about=ABOUT):
    """The reader's complaint, which must be one line that begins with the file."""
    with pytest.raises(InputError) as caught:
        checkpoint.read(path, state() if template is None else template, about)
    text = str(caught.value)
    assert "\n" not in text and text.startswith(f"{path}: ")
    assert text.endswith("; remove it to start again, or name another folder by --out")
    return text.removeprefix(f"{path}: ").split(";")[0]


@pytest.fixture
def kept(tmp_path):
    path = tmp_path / "state.npz"
    checkpoint.write(path, state(), ABOUT)
    return path


def test_a_state_comes_back_bit_for_bit(kept):
    check_equal(checkpoint.read(kept, state(seed=1), ABOUT), state())
    assert [file.name for file in kept.parent.iterdir()] == [kept.name]


@pytest.mark.parametrize("whole", [True, False])
def test_the_state_of_a_tuning_comes_back_with_its_optimiser(tmp_path, whole):
    start = fitting.init(
        NoiseParams.for_laser_log(),
        frozen=["wall_angle_std"],
        num_updates=4,
        optimizer=optimizers.default_optimizer(4, whole=whole),
    )
    moved = jax.tree.map(lambda x: np.asarray(x + np.ones((), np.asarray(x).dtype)), start)
    checkpoint.write(tmp_path / "a", moved, ABOUT)
    found = checkpoint.read(tmp_path / "a", start, ABOUT)
    check_equal(found, moved)
    kept = found.optimizer_state if whole else found.optimizer_state[0]
    assert isinstance(kept, BacktrackState if whole else optax.ScaleByAdamState)
    assert (kept.theta if whole else kept.mu).shape == (7,)


def test_nothing_in_the_file_is_pickled(kept):
    with np.load(kept, allow_pickle=False) as file:
        assert all(file[name].dtype.kind in "fiubU" for name in file.files)


def full(*_, **__):
    raise OSError(28, "No space left on device")


def half(file, **_):
    file.write(b"PK\3\4 half of it")
    full()


@pytest.mark.parametrize("module, name, fails", [(np, "savez", half), (os, "fsync", full)])
def test_a_failure_while_writing_leaves_the_old_state(kept, monkeypatch, module, name, fails):
    with monkeypatch.context() as patch:
        patch.setattr(module, name, fails)
        with pytest.raises(InputError) as caught:
            checkpoint.write(kept, state(seed=1), ABOUT)
    assert str(caught.value).startswith(f"{kept}: cannot be written (No space left on device); ")
    check_equal(checkpoint.read(kept, state(), ABOUT), state())
    assert [file.name for file in kept.parent.iterdir()] == [kept.name]


def test_a_stop_while_writing_leaves_the_old_state(kept, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", stop)
    with pytest.raises(KeyboardInterrupt):
        checkpoint.write(kept, state(seed=1), ABOUT)
    check_equal(checkpoint.read(kept, state(), ABOUT), state())
    assert [file.name for file in kept.parent.iterdir()] == [kept.name]


def test_a_new_state_replaces_the_old_one(kept):
    checkpoint.write(kept, state(seed=1), ABOUT | {"seed": 5})
    check_equal(checkpoint.read(kept, state(), ABOUT | {"seed": 5}), state(seed=1))
    assert complaint(kept) == "seed: belongs to another run"


def test_it_goes_into_folders_that_exist_only(tmp_path):
    with pytest.raises(InputError, match="cannot be written .*; name a folder that exists"):
        checkpoint.write(tmp_path / "none" / "a.npz", state(), ABOUT)


@pytest.mark.parametrize(
    "change, field",
    [
        ({"steps": 4}, "steps"),
        ({"seed": 0}, "seed"),
        ({"rate": np.nextafter(0.1, 1.0)}, "rate"),
        ({"frozen": []}, "frozen"),
        ({"noise": NoiseParams.for_landmark_sensor()}, "noise"),
        ({"another": 1}, "another"),
    ],
)
def test_a_state_of_another_run_is_refused_by_the_field_that_differs(kept, change, field):
    assert complaint(kept, about=ABOUT | change) == f"{field}: belongs to another run"
    fewer = {name: value for name, value in ABOUT.items() if name != "rate"}
    assert complaint(kept, about=fewer) == "rate: belongs to another run"


@pytest.mark.parametrize(
    "other",
    [
        state()._replace(numbers=np.zeros((4, 3))),
        state()._replace(numbers=np.zeros((3, 4), np.float32)),
        state()._replace(nothing=np.zeros(1)),
        state()._replace(pair=()),
    ],
    ids=["shape", "type", "more", "fewer"],
)
def test_a_state_of_other_shapes(kept, other):
    assert complaint(kept, other) == "belongs to another run (its shapes)"


def saved(**arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def array(content, **options):
    file = io.BytesIO()
    np.save(file, content, **options)
    return file.getvalue()


FOREIGN = {
    "empty": b"",
    "text": b"hello\n",
    "binary": bytes(range(256)),
    "json": b'{"about": {}}',
    "one array": array(np.arange(3)),
    "an object": array(np.array([{}], object), allow_pickle=True),
    "a pickle": pickle.dumps({"about": 1}),
    "an archive": saved(x=np.arange(3)),
    "no description": saved(leaf0=np.arange(3)),
    "pickled description": saved(about=np.array([{}], object)),
    "no JSON": saved(about="what", leaf0=np.arange(3)),
    "deep JSON": saved(about="[" * 100_000, leaf0=np.arange(3)),
    "leaves missing": saved(about="{}", leaf1=np.arange(3)),
}


@pytest.mark.parametrize("content", FOREIGN.values(), ids=FOREIGN.keys())
def test_a_file_of_another_kind(tmp_path, content):
    path = tmp_path / "state.npz"
    path.write_bytes(content)
    assert complaint(path).startswith("is no checkpoint (")


def test_a_description_that_is_no_record(tmp_path):
    (tmp_path / "a").write_bytes(saved(about="[1]", leaf0=np.arange(3)))
    assert complaint(tmp_path / "a").endswith(": belongs to another run")


def test_a_missing_file_and_a_folder(tmp_path):
    assert complaint(tmp_path / "none") == "is no checkpoint (FileNotFoundError)"
    assert complaint(tmp_path) == "is no checkpoint (IsADirectoryError)"


def test_no_damage_goes_unnoticed(kept):
    """Cut anywhere, or a byte changed anywhere: the state itself, or a complaint."""
    good, rng = kept.read_bytes(), np.random.default_rng(0)
    for size in rng.integers(0, len(good), 60):
        kept.write_bytes(good[:size])
        assert complaint(kept).startswith("is no checkpoint (")
    noticed = 0
    for place in rng.integers(0, len(good), 400):
        damaged = bytearray(good)
        damaged[place] ^= 1 << rng.integers(8)
        kept.write_bytes(damaged)
        try:
            check_equal(checkpoint.read(kept, state(), ABOUT), state())
        except InputError:
            noticed += 1
    assert noticed > 100
