import numpy as np
import pytest

from experiments import floor_plan_places, place_picture, place_recognition
from experiments.log_folder import Log
from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose

LIDAR = Lidar(32, -np.pi / 2, np.pi / 32, 20.0, 0.02)


def row(right, in_map, certainty=1.2, margin=0.2):
    places = {"right": right, "confidence": certainty}
    return {"in_map": in_map, "margin": margin, "places": places}


def test_precision_is_of_what_was_accepted_and_recall_of_what_is_in_the_map():
    rows = [row(True, True)] * 6 + [row(False, True)] * 2 + [row(True, True, margin=0.01)] * 3
    rows += [row(True, False)] + [row(False, False, certainty=0.5)] * 8
    found = place_recognition.summary(rows)
    assert (found["queries"], found["in_map"], found["accepted"]) == (20, 11, 9)
    assert found["precision"] == pytest.approx(7 / 9) and found["recall"] == pytest.approx(6 / 11)
    assert found["precision_low"] < 7 / 9 < found["precision_high"]
    nothing = place_recognition.summary([row(False, False, certainty=0.1)])
    assert nothing["precision"] is None and nothing["recall"] is None


def test_within_is_by_distance_and_turn():
    pose = np.array([3.0, -2.0, 3.1])
    offs = np.array([[0.3, 0.3, 0.0], [0.0, 0.6, 0.0], [0.0, 0.0, 0.17], [0.0, 0.0, -0.18]])
    found = place_recognition._within(pose, compose(pose, offs), place_recognition.RIGHT)
    assert found.tolist() == [True, False, True, False]


def test_logs_without_a_reference_are_refused(tmp_path, monkeypatch, capsys):
    poses = np.zeros((4, 3))
    laser_log = LaserLog.from_arrays(np.arange(4), poses, np.ones((4, 32)), LIDAR)
    log = Log("hall", tmp_path, laser_log, None, None)
    monkeypatch.setattr(place_recognition.log_folder, "find_logs", lambda *_, **__: [log])
    assert place_recognition.main(["--out", str(tmp_path / "out")]) == 2
    assert "no log with a reference trajectory" in capsys.readouterr().err
    for flag in ("--every", "--plans"):
        assert place_recognition.main(["--out", str(tmp_path / "out"), flag, "0"]) == 2


@pytest.mark.slow
def test_a_log_is_run_and_its_places_are_looked_for(shared_data, tmp_path):
    found = place_recognition.log_folder.find_logs(shared_data / "freiburg-101", installed=False)
    numbers = place_recognition.run_log(found[0], 40)
    one = numbers["summary"]["other scans"]
    assert one["queries"] == 8 == one["in_map"]
    assert one["precision"] == 1.0 and one["recall"] >= 0.7
    sizes = [row["keyframes"] for row in numbers["timing"]]
    assert sizes == sorted(sizes) and sizes[-1] == numbers["keyframes"]
    for method, recall in numbers["methods"]["other scans"].items():
        assert method == "places" or recall <= numbers["methods"]["other scans"]["places"]
    summary = floor_plan_places.summary(
        [
            {"factor": factor, "value": value, "accepted": True, "right": True}
            for factor, values in floor_plan_places.LEVELS.items()
            for value in values
        ]
    )
    drawn = {"logs": {"freiburg": numbers}, "floor_plans": {"summary": summary}}
    place_picture.draw(drawn, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000
