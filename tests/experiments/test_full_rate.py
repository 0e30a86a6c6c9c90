import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments import full_rate, log_folder, real_logs
from experiments.common import ResultCache
from experiments.log_folder import Log
from jaxslam.core.logs import LaserLog, Relations
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import dead_reckoning
from jaxslam.pipeline import log_input

LIDAR = Lidar(32, -np.pi / 2, np.pi / 32, 20.0, 0.02)
KEYS = {"log", "method", "scans", "source", "warned", "used", *full_rate.KEYS, "translation_max_m"}


def log_of(name, num_scans, pairs, folder="a"):
    poses = dead_reckoning(np.zeros(3), np.tile([0.5, 0.0, 0.1], (num_scans, 1)))
    ranges = np.random.default_rng(0).uniform(1.0, 9.0, (num_scans, 32))
    laser_log = LaserLog.from_arrays(np.arange(num_scans), poses, ranges, LIDAR)
    return Log(name, Path(folder), laser_log, None, pairs)


def relations(*times):
    t1, t2 = np.array(times).T
    return Relations(t1, t2, np.zeros((len(times), 3)))


ON_SCANS, BETWEEN = relations((0.001, 3.0), (2.0, 4.999)), relations((0.0, 3.0), (2.0, 4.5))


def test_of_each_name_the_log_with_most_scans_at_the_times_is_taken():
    logs = [log_of("aces", 8, ON_SCANS), log_of("aces", 9, ON_SCANS), log_of("aces", 10, BETWEEN)]
    logs += [log_of("hall", 9, None), log_of("attic", 7, BETWEEN), log_of("cellar", 6, ON_SCANS)]
    found = full_rate.select(logs)
    assert [(log.name, len(log.laser_log.times)) for log in found] == [("aces", 9), ("cellar", 6)]
    fewest = [(log.name, len(log.laser_log.times)) for log in real_logs.select(logs)]
    assert fewest == [("aces", 8), ("hall", 9), ("attic", 7), ("cellar", 6)]


def test_relations_get_the_times_of_their_scans():
    found = log_folder.at_scans(np.array([3.0, 0.0, 5.0, 2.0]), ON_SCANS)
    assert (found.t1.tolist(), found.t2.tolist()) == ([0.0, 2.0], [3.0, 5.0])
    found = log_folder.at_scans(np.array([3.0, 0.0, 2.0]), ON_SCANS)
    assert (found.t1.tolist(), found.t2.tolist()) == ([0.0], [3.0])
    assert log_folder.has_scans_at(np.array([3.0, 0.0, 5.0, 2.0]), ON_SCANS)
    assert not log_folder.has_scans_at(np.array([3.0, 0.0, 2.0]), ON_SCANS)


def test_logs_of_one_name_are_told_apart():
    logs = [log_of("a", 2, None, folder) for folder in ("x", "y", "v/y")]
    names = log_folder.unique_names([*logs, log_of("b", 2, None)])
    assert names == ["x-a", "y-a-1", "y-a-2", "b"]


def test_references_belong_to_the_log_beside_them_or_to_scans_at_all_their_times(tmp_path):
    for folder, steps in (("full", 0.5), ("thin", 2.0)):
        (tmp_path / folder).mkdir()
        lines = [
            f"FLASER 4 1.0 1.5 2.0 2.5 {0.1 * t} 0 0 {0.1 * t} 0 0 {t} host {t}\n"
            for t in np.arange(0.0, 9.0, steps)
        ]
        (tmp_path / folder / "hall.clf").write_text("".join(lines))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "hall.relations").write_text("1.5 2.5 0.5 0.25 0 0 0 0.125\n")
    reference = [f"{t} {0.1 * t} 0 0 0 0 0 1\n" for t in np.arange(0.0, 9.0, 2.0)]
    (tmp_path / "thin" / "hall.reference.tum").write_text("".join(reference))
    full, thin = log_folder.find_logs(tmp_path, installed=False)
    assert (full.folder.name, thin.folder.name) == ("full", "thin")
    assert full.relations is not None and thin.relations is None
    assert len(full.reference[0]) == len(thin.reference[0]) == 5
    (tmp_path / "thin" / "hall.reference.tum").write_text("".join(reference) + "8.3 1 0 0 0 0 0 1")
    full, thin = log_folder.find_logs(tmp_path, installed=False)
    assert full.reference is None and len(thin.reference[0]) == 6


@pytest.mark.parametrize("name", full_rate.PUBLISHED)
def test_published_figures_have_the_keys_of_a_row_and_a_source(name):
    rows = full_rate.published_rows(name)
    assert all(row.keys() == KEYS and row["source"] and row["log"] == name for row in rows)
    mean = {row["method"]: row["translation_mean_m"] for row in rows}
    assert mean["Cartographer"] < mean["particle filter"] < mean["scan matching"]
    assert full_rate.published_rows("attic") == []


@pytest.fixture
def by_odometry(monkeypatch):
    """SLAM that returns odometry, without its turns."""

    def run(given, callback=None):
        poses = given.odom_poses * [1.0, 1.0, 0.0]
        return SimpleNamespace(poses=poses, notes=(), consistency=SimpleNamespace(warnings=(1,)))

    monkeypatch.setattr(log_input, "run", run)


def test_rows_of_a_run_stand_beside_the_odometry(by_odometry, tmp_path):
    log = log_of("aces", 9, ON_SCANS)
    poses = log.laser_log.odom_poses
    rows = full_rate.compute([log], ResultCache(tmp_path / "parts", 0))
    assert all(row.keys() == KEYS for row in rows) and len(rows) == 2 + 4
    own, wheels = rows[:2]
    distance = np.hypot(*(poses[[3, 5], :2] - poses[[0, 2], :2]).T)
    for row in (own, wheels):
        assert row["translation_mean_m"] == pytest.approx(distance.mean())
        assert row["translation_max_m"] == pytest.approx(distance.max())
        assert row["used"] == 2 and row["scans"] == 9
    assert own["rotation_mean_deg"] == pytest.approx(0.0, abs=1e-9) and own["warned"]
    assert wheels["rotation_mean_deg"] == pytest.approx(np.degrees(0.3))
    assert "WARNING" in full_rate.line(own) and "0.0375 +- 0.0426 m" in full_rate.line(rows[-1])
    full_rate.draw(rows, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 5_000


@pytest.mark.parametrize("ablation", [0, 1])
def test_real_logs_runs_the_parts_that_are_wanted(ablation, by_odometry, tmp_path, monkeypatch):
    monkeypatch.setattr(log_folder, "find_logs", lambda _: [log_of("aces", 9, ON_SCANS)])
    monkeypatch.setattr(real_logs, "compute", lambda logs, *_: {"rows": len(logs), "ways": {}})
    given = ["--out", str(tmp_path), "--ablation", str(ablation)]
    assert real_logs.main([*given, "--full_rate", "1"]) == 0
    numbers = json.loads((tmp_path / "real_logs.json").read_text())
    assert numbers["rows"] == (1 if ablation else []) and len(numbers["full_rate"]) == 6
    assert (tmp_path / "real_logs.png").is_file()
    assert real_logs.main([*given, "--full_rate", "0"]) == (0 if ablation else 2)
