"""What `jaxslam run` and `tune` make of logs: options of the scanner, notes, missing odometry."""

import json

import jax
import layouts
import numpy as np
import pytest

import jaxslam
from jaxslam.cli import main
from jaxslam.core.se2_np import compose
from jaxslam.io import tum
from jaxslam.pipeline import SlamState, log_input, topological_map


def refused(capsys, *arguments):
    assert main.main([*map(str, arguments)]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    return line.removeprefix("jaxslam: error: ")


def still(path):
    """A log whose wheels never turn."""
    scan = f"FLASER 40 {'2.5 ' * 40}1 2 0.5 1 2 0.5"
    path.write_text("".join(f"{scan} {t} host {t}\n" for t in range(60)))
    return path


def test_run_refuses_scans_of_a_few_beams(tmp_path, capsys):
    log = layouts.carmen(tmp_path / "a.clf", layouts.messages())
    assert "has 8 beams a scan, of which 32 are needed" in refused(capsys, "run", log)


@pytest.mark.parametrize("command", ["run", "tune"])
def test_a_log_without_odometry_is_refused_by_what_needs_the_wheels(tmp_path, capsys, command):
    log = still(tmp_path / "a.clf")
    options = ["--odometry", "wheels", "--out", tmp_path / "out"]
    options += ["--loss", "innovation_nll"] if command == "tune" else []
    line = refused(capsys, command, log, *options)
    assert line.startswith(f"{log}: no odometry: its pose is the same in all 60")
    assert line.endswith("use --odometry scans-only") and not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["run", "tune"])
@pytest.mark.parametrize(
    "options, message",
    [
        (["--mount", 0, 0, 180], "mount: a yaw of 180 is no angle; give the yaw in radians"),
        (["--scan-frame", "rear"], "scan_frame: there are no scans of the frame 'rear'"),
        (["--angle-increment", 0], "angle_increment: 0.0 rad is no step"),
    ],
)
def test_options_of_the_scanner_reach_the_reader(tmp_path, capsys, command, options, message):
    log = layouts.carmen(tmp_path / "a.clf", layouts.messages())
    line = refused(capsys, command, log, *options, "--out", tmp_path / "out")
    assert message in line


def test_a_reference_without_headings_is_refused_by_tune(tmp_path, capsys):
    log = layouts.carmen(tmp_path / "a.clf", layouts.messages())
    poses = layouts.true_poses()
    lines = [
        f"{t} {x} {y} 0 0 0 0 1\n" for t, (x, y, _) in zip(layouts.true_times(), poses, strict=True)
    ]
    (tmp_path / "a.tum").write_text("".join(lines))
    options = ["--reference", tmp_path / "a.tum", "--out", tmp_path / "out"]
    assert "quaternions hold no heading" in refused(capsys, "tune", log, *options)


def room_scan(pose, beams=180):
    """Ranges of a half circle of beams in a room of 14 x 9 m."""
    angle = pose[2] + np.pi * (np.arange(beams) / beams - 0.5)
    x, y = np.cos(angle), np.sin(angle)
    east_west = np.where(x > 0, 10.0 - pose[0], 4.0 + pose[0]) / np.maximum(np.abs(x), 1e-9)
    north_south = np.where(y > 0, 4.0 - pose[1], 5.0 + pose[1]) / np.maximum(np.abs(y), 1e-9)
    return np.minimum(east_west, north_south)


def room_log(path):
    """A bag of a drive in the room."""
    poses = iter(layouts.true_poses())
    said = [
        m._replace(data=room_scan(next(poses))) if m.kind == "scan" else m
        for m in layouts.messages()
    ]
    layouts.bag(path, said)
    return path


@pytest.mark.slow
def test_a_later_session_loads_what_a_run_has_saved(tmp_path, monkeypatch):
    results, run = [], log_input.run
    monkeypatch.setattr(
        log_input, "run", lambda *a, **k: results.append(run(*a, **k)) or results[0]
    )
    log = room_log(tmp_path / "a")
    assert main.main(["run", str(log), "--no-smooth", "--out", str(tmp_path / "out")]) == 0
    saved, (result,) = jaxslam.load_map(tmp_path / "out"), results
    given = log_input.from_laser_log(jaxslam.read_log(log))
    keyframes, used = result.keyframes, np.asarray(result.belief.num_seen) > 0
    np.testing.assert_array_equal(saved.poses, result.poses[keyframes])
    np.testing.assert_array_equal(saved.times, jaxslam.read_log(log).times[keyframes])
    np.testing.assert_array_equal(saved.scans.hit, np.asarray(given.scans.hit)[keyframes])
    ranges = np.asarray(given.scans.ranges, np.float32)[keyframes]
    np.testing.assert_array_equal(saved.scans.ranges, ranges)
    assert saved.lidar == given.config.frontend.lidar
    positions = np.asarray(result.belief.landmark_positions)
    np.testing.assert_array_equal(saved.belief.landmark_positions, positions[used])
    rows = np.concatenate([np.ones(3, bool), np.repeat(used, 2)])  # of pose and used landmarks
    cov = np.asarray(result.belief.cov)[np.ix_(rows, rows)]
    np.testing.assert_allclose(saved.belief.cov, cov)
    assert used.sum() > 2 and not used.all() and len(result.topological_map.id) > 1
    jax.tree.map(np.testing.assert_array_equal, saved.topological_map, result.topological_map)
    # The landmarks and arcs in the file are all that the merged map is made of.
    states = SlamState(saved.belief, saved.arcs, None), SlamState(result.belief, result.arcs, None)
    merged = [topological_map(given.config, state, saved.poses) for state in states]
    jax.tree.map(np.testing.assert_array_equal, *merged)
    features = json.loads((tmp_path / "out" / "map.geojson").read_text())["features"]
    points = [
        f
        for f in features
        if f["geometry"]["type"] == "Point" and f["properties"]["metadata"]["kind"] != "frontier"
    ]
    assert [f["properties"]["id"] for f in points] == saved.topological_map.id.tolist()
    xy = [f["geometry"]["coordinates"] for f in points]
    np.testing.assert_array_equal(xy, saved.topological_map.xy)


@pytest.mark.slow
def test_poses_of_the_robot_and_notes(tmp_path, capsys):
    """Those of the scanner are the robot's, moved by the mount."""
    mount, log = np.array([0.3, -0.1, 0.5]), room_log(tmp_path / "a")
    found = {}
    for frame in ("scanner", "base"):
        out = tmp_path / frame
        options = ["--mount", *mount, "--pose-frame", frame, "--no-smooth", "--out", out]
        assert main.main(["run", str(log), *map(str, options)]) == 0
        found[frame] = tum.read(out / "trajectory.tum")[1]
    np.testing.assert_allclose(compose(found["base"], mount), found["scanner"], atol=1e-5)
    assert main.main(["run", str(log), "--no-smooth", "--out", str(tmp_path / "c")]) == 0
    notes = json.loads((tmp_path / "c" / "metrics.json").read_text())["mended"]
    assert len(notes) == 1 and "no transform from 'base_link' to 'laser'" in notes[0]
    assert f"note: {notes[0]}" in capsys.readouterr().out
