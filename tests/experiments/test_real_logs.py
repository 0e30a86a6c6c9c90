import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import log_folder, real_logs
from jaxslam.core.episode import Episode
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.frontend.features import features_from_range_bearing
from jaxslam.io import tum


def write_log(path):
    """A CARMEN log of ten scans of four beams."""
    lines = []
    for t in range(10):
        pose = f"{0.1 * t} 0 0"
        lines.append(f"FLASER 4 1.0 1.5 2.0 2.5 {pose} {pose} {t} host {t}")
        lines.append(f"ODOM {pose} 0.3 0.1 0 {t + 0.5} host {t + 0.5}")
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def folder(tmp_path):
    """A log with a reference and relations, and one with nothing; not the only files."""
    (tmp_path / "one").mkdir()
    write_log(tmp_path / "one" / "hall.clf")
    tum.write(tmp_path / "one" / "hall.reference.tum", np.arange(5.0), np.ones((5, 3)))
    (tmp_path / "one" / "hall.relations").write_text("1 2 0.5 0.25 0 0 0 0.125\n")
    write_log(tmp_path / "attic.log")
    (tmp_path / "notes.txt").write_text("of no interest\n")
    return tmp_path


def test_logs_are_found_with_their_references(folder):
    found = {one.name: one for one in log_folder.find_logs(folder)}
    found.pop("killian", None)  # where its package is installed
    assert set(found) == {"hall", "attic"}
    assert len(found["hall"].reference[0]) == 5 and len(found["hall"].relations[0]) == 1
    assert found["attic"].reference is None and found["attic"].relations is None
    assert len(found["hall"].laser_log.times) == 10


@pytest.mark.parametrize("landmarks, kinds", real_logs.LANDMARKS.items())
def test_kinds_that_are_left_out_are_no_features(landmarks, kinds):
    polar = jnp.asarray(np.random.default_rng(0).uniform(1, 2, (6, 2)))
    kind = jnp.array([JUNCTION, CORNER, WALL, JUNCTION, CORNER, WALL], jnp.int32)
    features = features_from_range_bearing(polar, jnp.ones(6, bool), 0.01)._replace(kind=kind)
    log = Episode(np.zeros((1, 3)), np.zeros((1, 3)), jax.tree.map(lambda x: x[None], features))
    some = real_logs.restrict(log, "wheels", landmarks)
    np.testing.assert_array_equal(some.features.valid[0], np.isin(kind, kinds))


def test_a_picture_is_drawn_of_logs_with_and_without_reference(tmp_path):
    rows, trajectories = [], {}
    for log, known in (("hall", "ate_rmse_m"), ("attic", "relations_translation_m")):
        path = np.cumsum(np.ones((9, 2)), axis=0)
        trajectories[log] = {"wheels": 2 * path, "estimate": path}
        for odometry in real_logs.ODOMETRY:
            for k, landmarks in enumerate(real_logs.LANDMARKS):
                row = {"ate_rmse_m": None, "relations_translation_m": None, "nees": None}
                row |= {"log": log, "odometry": odometry, "landmarks": landmarks}
                row |= {"noise": "default", "ms_per_scan": 5.0, known: 1.0 + k}
                rows.append(row | {f"filter_{known}": 2.0 + k})
    trajectories["hall"]["reference"] = trajectories["hall"]["estimate"]
    real_logs.draw({"rows": rows, "ways": trajectories, "full_rate": []}, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000
    assert "1.000 m ATE (filter 2.000)" in real_logs.line(rows[0])
    assert "relations" in real_logs.line(rows[-1])


def test_a_folder_that_does_not_exist_is_reported(tmp_path, capsys):
    argv = ["--out", str(tmp_path / "out"), "--data", str(tmp_path / "nowhere")]
    assert real_logs.main(argv) == 2
    assert "is no folder" in capsys.readouterr().err and not (tmp_path / "out").exists()
