import numpy as np
import pytest
from tune_logs import write_carmen, write_mrclam

from jaxslam.cli import main, tune_command
from jaxslam.io import tum
from jaxslam.tuning import fitting


@pytest.fixture
def refused_by_tune(tmp_path, capsys, monkeypatch):
    """Function that runs bad arguments, checks how they are refused, and returns the line."""
    monkeypatch.setattr(tune_command, "enable_caches", lambda: None)
    monkeypatch.setattr(fitting, "gradients_of", lambda *_: pytest.fail("work has begun"))

    def refuse(*arguments, out=None):
        fresh = out is None
        out = tmp_path / "results" if fresh else out
        before = {} if fresh else contents(out)
        assert main.main(["tune", *map(str, arguments), "--out", str(out)]) == 2
        line = capsys.readouterr().err.splitlines()[-1]
        assert line.startswith("jaxslam: error: ")
        assert not out.exists() if fresh else contents(out) == before
        assert not list(tmp_path.glob(".unfinished*"))
        return line.removeprefix("jaxslam: error: ")

    return refuse


def contents(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


@pytest.fixture
def log(tmp_path):
    return write_carmen(tmp_path / "a.clf")


@pytest.fixture
def reference(tmp_path):
    tum.write(tmp_path / "a.tum", np.arange(6) + 0.5, np.zeros((6, 3)))
    return tmp_path / "a.tum"


@pytest.fixture
def drives(tmp_path):
    return write_mrclam(tmp_path / "drives", robots=1, seconds=4.0)
