"""`jaxslam localise LOG --map DIR`: files, notes, refusals."""

import csv
import json
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.cli import localise_command, main
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose, relative
from jaxslam.io import tum
from jaxslam.simulation import path_following, ray_casting, worlds

LIDAR = Lidar(num_beams=180, angle_min=-np.pi / 2, angle_increment=np.pi / 180, range_max=15.0)
ODOMETRY_START = np.array([3.0, 7.0, 0.4])  # which says nothing of where the robot is
NUM_SCANS, FIRST = 60, 25


def scans_at(poses):
    cast = partial(ray_casting.cast, LIDAR, worlds.named("office"))
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(cast))(jnp.asarray(poses)))


def write_log(path, poses):
    """A CARMEN log whose odometry is that of the poses, in a frame of its own."""
    odometry = compose(ODOMETRY_START, relative(poses[0], poses))
    lines = []
    for t, (ranges, pose) in enumerate(zip(scans_at(poses).ranges, odometry, strict=True)):
        where = " ".join(f"{x:.6f}" for x in pose)
        beams = " ".join(f"{r:.3f}" for r in ranges)
        lines.append(f"FLASER {len(ranges)} {beams} {where} {where} {t} host {t}\n")
    path.write_text("".join(lines))
    return path


@pytest.fixture(scope="module")
def poses():
    """Poses (T, 3) of a drive through the office."""
    path = path_following.densify(worlds.waypoints("office"))
    return path_following.poses_along(path, 0.4)[:NUM_SCANS]


@pytest.fixture
def refused(tmp_path, capsys):
    """Function that runs bad arguments, and returns the line that says what is wrong."""

    def refuse(*arguments):
        out = tmp_path / "results"
        assert main.main(["localise", *map(str, arguments), "--out", str(out)]) == 2
        line = capsys.readouterr().err.splitlines()[-1]
        assert line.startswith("jaxslam: error: ") and not out.exists()
        return line.removeprefix("jaxslam: error: ")

    return refuse


@pytest.fixture
def saved(tmp_path, monkeypatch, poses):
    """A folder that stands for a map of the drive."""
    found = SimpleNamespace(lidar=LIDAR, poses=poses, scans=scans_at(poses))
    monkeypatch.setattr(localise_command.map_file, "load_map", lambda path: found)
    return tmp_path


def test_a_folder_without_a_map_is_refused(refused, tmp_path):
    line = refused(tmp_path / "a.clf", "--map", tmp_path)
    assert line.startswith(f"{tmp_path}: holds no map.npz")
    assert "does not exist" in refused(tmp_path / "a.clf", "--map", tmp_path / "none")


def test_results_are_not_written_into_the_folder_of_the_map(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "metrics.json").write_text("{}")
    for out in ("out", str(folder)):
        assert main.main(["localise", "a.clf", "--map", "out", "--out", out]) == 2
        line = capsys.readouterr().err
        assert line.startswith("jaxslam: error: --out: ") and line.count("\n") == 1
        assert "out is the folder of the map, whose results would be replaced; name" in line
    assert [file.name for file in folder.iterdir()] == ["metrics.json"]


def test_without_out_a_localisation_has_a_folder_of_its_own(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    assert main.main(["localise", "a.clf", "--map", "out"]) == 2
    assert "holds no map.npz" in capsys.readouterr().err


def test_a_log_without_scans_is_refused(refused, saved):
    (saved / "a.clf").write_text("ODOM 0 0 0 0 0 0 1 host 1\n")
    assert refused(saved / "a.clf", "--map", saved).startswith(f"{saved / 'a.clf'}: ")


@pytest.mark.parametrize(
    "at, message",
    [
        ((99, 0, 0), "--at: 99 0 is outside of the map; it reaches x "),
        (("nan", 0, 0), "--at: (nan, 0.0, 0.0) is not finite"),
    ],
)
def test_a_start_that_is_not_in_the_map_is_refused(refused, saved, poses, at, message):
    log = write_log(saved / "a.clf", poses[:3])
    assert refused(log, "--map", saved, "--at", *at).startswith(message)


def test_a_reference_of_another_time_is_refused(refused, saved, poses):
    log = write_log(saved / "a.clf", poses[:3])
    tum.write(saved / "a.tum", 1e6 + np.arange(3.0), poses[:3])
    line = refused(log, "--map", saved, "--reference", saved / "a.tum")
    assert line.startswith(f"{saved / 'a.tum'}: ")


def test_scanners_that_differ_are_noted():
    assert localise_command.differences(LIDAR, LIDAR._replace(range_std=0.03)) == []
    (note,) = localise_command.differences(LIDAR, LIDAR._replace(num_beams=91, range_max=8.0))
    assert note == (
        "scanner of the log: 91 beams over 90 degrees up to 8 m; "
        "of the map: 180 beams over 179 degrees up to 15 m"
    )


@pytest.mark.slow
def test_a_robot_is_found_in_the_map_of_a_run(tmp_path, poses, capsys):
    log, out = write_log(tmp_path / "map.clf", poses), tmp_path / "out"
    assert main.main(["run", str(log), "--out", str(tmp_path / "map")]) == 0
    frame = tum.read(tmp_path / "map" / "trajectory.tum")[1][FIRST]
    later = compose(poses[FIRST:], np.array([0.1, -0.1, 0.2]))
    log = write_log(tmp_path / "later.clf", later)
    tum.write(tmp_path / "later.tum", np.arange(len(later), dtype=float), later)
    given = ["localise", log, "--map", tmp_path / "map", "--reference", tmp_path / "later.tum"]
    assert main.main([*map(str, given), "--out", str(out)]) == 0
    files = {"metrics.json", "trajectory.tum", "quality.csv", "localised.png"}
    assert {file.name for file in out.iterdir()} == files
    numbers = json.loads((out / "metrics.json").read_text())
    assert numbers["scans"] == len(later) and numbers["sure"] > 0.8
    assert numbers["found_after_m"] < 5.0 and numbers["ate_rmse_m"] < 0.1
    with (out / "quality.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["t", "x", "y", "yaw", "probability"] and len(rows) == len(later)
    quality = np.array([[float(x) for x in row.values()] for row in rows])
    times, found = tum.read(out / "trajectory.tum")
    np.testing.assert_allclose(times, quality[quality[:, 4] >= 0.5, 0])
    right = compose(frame, relative(poses[FIRST], later))  # in the map
    off = relative(right[times.astype(int)], found)
    assert np.median(np.hypot(off[:, 0], off[:, 1])) < 0.1
    assert "scans with probability above 0.9" in capsys.readouterr().out
