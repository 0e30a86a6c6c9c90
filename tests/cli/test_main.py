import json
import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import networkx
import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.tools import file_interface
from PIL import Image

import jaxslam
from jaxslam.cli import main, run_command, simulate_command, tune_command
from jaxslam.cli.stopwatch import _covered
from jaxslam.core import se2
from jaxslam.core.se2 import transform
from jaxslam.core.se2_np import relative
from jaxslam.io import carmen, ros_map, tum
from jaxslam.simulation import drives, ray_casting, worlds
from jaxslam.simulation.worlds import World

# The commands run in processes of their own, in float32 as users run them; a short drive and
# programs that are little optimised (`conftest`) keep them quick.
SHORT_DRIVE = (
    "from jaxslam.simulation.worlds import WAYPOINTS; "
    "WAYPOINTS['office'] = WAYPOINTS['office'][:3]; "
)
MAIN = "import sys; from jaxslam.cli.main import main; sys.exit(main(sys.argv[1:]))"
SCANS = 24
PICTURES = ("path.png", "errors.png")


def begin(*arguments, cache):
    """Start the command line in a process of its own."""
    flags = os.environ["XLA_FLAGS"].replace("device_count=2", "device_count=1")  # compiles once
    own = {"XDG_CACHE_HOME": str(cache), "XLA_FLAGS": flags}
    keep = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    return subprocess.Popen(
        [sys.executable, "-c", SHORT_DRIVE + MAIN, *map(str, arguments)],
        env=keep | own,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def end(process):
    """Output and errors of a process that ended well."""
    said, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    return said, errors


def drive():
    """Poses (T, 3) along the southern corridor of the office, and wheel odometry that drifts."""
    part = np.linspace(0.0, 1.0, SCANS)
    poses = np.stack([1.0 + 6.0 * part, 0.9 + 0.0 * part, 0.1 * np.sin(6 * part)], axis=1)
    return poses, poses + np.stack([0.0 * part, 0.4 * part**2, 0.1 * part], axis=1) + [3.0, -2.0, 0]


def write_log(path):
    """A CARMEN log of the drive with one broken line."""
    sensor = carmen.half_circle_lidar(181, 20.0)
    walls = World(jnp.asarray(worlds.named("office").walls))
    poses, wheels = drive()
    scans = jax.vmap(lambda pose: ray_casting.cast(sensor, walls, pose).ranges)(jnp.asarray(poses))
    text = ["# a drive", "FLASER 181 1.0 2.0"]
    for t, (ranges, wheel) in enumerate(zip(np.asarray(scans), wheels, strict=True)):
        numbers = [*ranges, *wheel, *wheel]
        text.append(f"FLASER 181 {' '.join(f'{x:.4f}' for x in numbers)} {t + 0.5} host {t}.5")
    path.write_text("\n".join(text) + "\n")
    return path


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Results of both commands, which run side by side."""
    place = tmp_path_factory.mktemp("cli")
    log = write_log(place / "corridor.clf")
    stamps, (poses, _) = np.arange(SCANS) + 0.5, drive()
    tum.write(place / "reference.tum", stamps, poses)
    steps = zip(stamps[:-1], stamps[1:], drive()[0][:-1], drive()[0][1:], strict=True)
    lines = ["{} {} {} {} 0 0 0 {}".format(a, b, *relative(p, q)) for a, b, p, q in steps]
    (place / "pairs.relations").write_text("\n".join(lines) + "\n")
    options = ["--reference", place / "reference.tum", "--relations", place / "pairs.relations"]
    simulated = begin(
        "simulate", "--trials", 2, "--seed", 3, "--out", place / "simulated", cache=place / "cache"
    )
    options += ["--scan", 3, "--gif", "--out", place / "a" / "recorded"]
    recorded = begin("run", log, *options, cache="/dev/null/not-a-folder")
    said, errors = end(simulated)
    return SimpleNamespace(
        place=place,
        simulated=place / "simulated",
        recorded=place / "a" / "recorded",
        said=said,
        errors=errors,
        said_of_log=end(recorded)[0],
    )


def load(folder):
    return json.loads((folder / "metrics.json").read_text())


def nodes(folder):
    """Positions in map.geojson of the nodes by id, but for open ends."""
    features = json.loads((folder / "map.geojson").read_text())["features"]
    points = [
        f
        for f in features
        if f["geometry"]["type"] == "Point"
        and f["properties"].get("metadata", {}).get("kind") != "frontier"
    ]
    return {f["properties"]["id"]: f["geometry"]["coordinates"] for f in points}


def check_map(folder):
    features = json.loads((folder / "map.geojson").read_text())["features"]
    kinds = {f["properties"].get("metadata", {}).get("kind") for f in features}
    assert {"node", "corner"} & kinds


def check_pictures(folder):
    for name in PICTURES:
        assert (folder / name).read_bytes().startswith(b"\x89PNG"), name


@pytest.mark.slow
def test_simulate_writes_its_files_and_nothing_else(done):
    names = {"metrics.json", "trajectory.tum", "truth.tum", "map.geojson", *PICTURES}
    assert {file.name for file in done.simulated.iterdir()} == names
    check_map(done.simulated)
    check_pictures(done.simulated)


@pytest.mark.slow
def test_simulate_measures_what_it_promises(done):
    numbers = load(done.simulated)
    assert numbers["runs"] == 2 and numbers["diverged"] == 0
    assert numbers["scans"] % 2 == 0 and numbers["scans"] > 20
    assert 4.0 < numbers["path_length_m"] < 7.0
    assert 0.0 < numbers["position_rmse_m"] < 0.3 and 0.0 < numbers["heading_rmse_deg"] < 5.0
    assert 0.0 < numbers["ate_rmse_m"] < numbers["position_rmse_m"] + 1e-6
    assert 0.0 < numbers["nees"] < 10.0
    assert numbers["landmarks"] > 0 and numbers["matches"] > 0
    assert set(numbers["seconds"]) == {"compile", "run"} and min(numbers["seconds"].values()) >= 0
    assert {"position_rmse_m", "heading_rmse_deg"} <= numbers["dead_reckoning"].keys()


@pytest.mark.slow
def test_simulate_prints_its_first_result_and_a_summary(done):
    assert "first 2 trials: position RMSE" in done.said + done.errors
    assert "2/2" in done.errors
    assert "position RMSE" in done.said and str(done.simulated) in done.said
    assert len(done.said.splitlines()) < 24


@pytest.mark.slow
def test_simulate_keeps_compiled_programs(done):
    assert any((done.place / "cache" / "jaxslam").iterdir())


@pytest.mark.slow
def test_evo_reads_the_trajectories(done):
    found, truth = (
        file_interface.read_tum_trajectory_file(done.simulated / name)
        for name in ("trajectory.tum", "truth.tum")
    )
    truth, found = sync.associate_trajectories(truth, found)
    error = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    error.process_data((truth, found))
    assert 0.0 < error.get_statistic(evo_metrics.StatisticsType.rmse) < 0.3


@pytest.mark.slow
def test_run_writes_its_files_and_nothing_else(done):
    names = {"metrics.json", "trajectory.tum", "map.geojson", "map.graphml", "map.yaml", "map.pgm"}
    names |= {
        "map.lif.json",
        "map.nav2.geojson",
        "map.rmf.yaml",
        "map.png",
        "rooms.json",
        "rooms.png",
        "map.npz",
        "graph.g2o",
        "scan.png",
        "run.gif",
        *PICTURES,
    }
    assert {file.name for file in done.recorded.iterdir()} == names
    assert [file.name for file in done.recorded.parent.iterdir()] == ["recorded"]
    check_map(done.recorded)
    check_pictures(done.recorded)
    assert (done.recorded / "scan.png").read_bytes().startswith(b"\x89PNG")
    with Image.open(done.recorded / "run.gif") as animation:
        assert animation.n_frames == load(done.recorded)["keyframes"] < SCANS


@pytest.mark.slow
def test_the_occupancy_map_of_a_run_agrees_with_the_world(done):
    """Cells that are occupied lie on walls, and most walls that were seen are in the map."""
    found = ros_map.read(done.recorded / "map.yaml")
    assert found.resolution == 0.05
    frame = drive()[0][0]
    cells = np.argwhere(found.occupied) + 0.5
    points = transform(jnp.asarray(frame), jnp.asarray(cells * 0.05 + found.origin[:2]))
    walls = worlds.named("office").walls
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    off = np.asarray(points)[:, None] - start[None]
    part = np.clip(np.sum(off * along, -1) / np.sum(along**2, -1), 0.0, 1.0)
    away = np.linalg.norm(off - part[..., None] * along, axis=-1).min(axis=1)
    assert len(points) > 200 and np.quantile(away, 0.95) < 0.15


@pytest.mark.slow
def test_networkx_reads_the_graph(done):
    graph = networkx.read_graphml(done.recorded / "map.graphml")
    known = {node for node, kind in graph.nodes(data="kind") if kind != "frontier"}
    assert known == {str(node) for node in nodes(done.recorded)}


@pytest.mark.slow
def test_the_saved_map_is_that_of_the_other_files(done):
    """Nodes of map.geojson, and poses, smoothed, of trajectory.tum at the keyframes."""
    saved = jaxslam.load_map(done.recorded)
    times, poses = tum.read(done.recorded / "trajectory.tum")
    assert len(saved.times) == load(done.recorded)["keyframes"]
    of_keyframes = np.searchsorted(times, saved.times)
    np.testing.assert_array_equal(times[of_keyframes], saved.times)
    np.testing.assert_allclose(saved.poses, poses[of_keyframes], atol=1e-6)
    assert saved.scans.ranges.dtype == saved.belief.mean.dtype == np.float32
    assert nodes(done.recorded) == dict(
        zip(saved.topological_map.id.tolist(), saved.topological_map.xy.tolist(), strict=True)
    )


@pytest.mark.slow
def test_run_beats_its_odometry(done):
    numbers = load(done.recorded)
    blind = numbers["dead_reckoning"]
    assert numbers["scans"] == SCANS and numbers["skipped_lines"] == 1
    assert numbers["path_length_m"] == pytest.approx(6.0, abs=0.3)
    assert numbers["ate_rmse_m"] < 0.5 * blind["ate_rmse_m"]
    assert numbers["matched"] == SCANS and numbers["relations"]["used"] == SCANS - 1
    assert {"translation_mean_m", "translation_std_m", "rotation_mean_deg", "rotation_std_deg"} <= (
        numbers["relations"].keys() & blind["relations"].keys()
    )
    assert numbers["heading_rmse_deg"] < blind["heading_rmse_deg"]
    assert numbers["filter"].keys() == blind.keys()
    assert numbers["filter"]["ate_rmse_m"] != numbers["ate_rmse_m"]  # it was smoothed


@pytest.mark.slow
def test_run_starts_at_the_origin_on_the_clock_of_the_log(done):
    times, poses = tum.read(done.recorded / "trajectory.tum")
    np.testing.assert_allclose(times, np.arange(SCANS) + 0.5)
    np.testing.assert_allclose(poses[0], 0.0, atol=1e-6)


@pytest.mark.slow
def test_run_checks_its_map(done):
    consistency = load(done.recorded)["map_consistency"]
    assert consistency["explained"] == 1.0 and consistency["warnings"] == []
    assert "explained scans" in done.said_of_log and "WARNING" not in done.said_of_log


@pytest.mark.slow
def test_run_says_how_many_lines_it_skipped(done):
    assert "1 broken lines" in done.said_of_log or "1 broken line" in done.said_of_log


@pytest.fixture
def refused(tmp_path, capsys, monkeypatch):
    """Function that runs bad arguments, checks how they are refused, and returns the line."""
    for module in (run_command, simulate_command, tune_command):
        monkeypatch.setattr(module, "enable_caches", lambda: None)

    def refuse(*arguments):
        out = tmp_path / "results"
        assert main.main([*map(str, arguments), "--out", str(out)]) == 2
        line = capsys.readouterr().err
        assert line.startswith("jaxslam: error: ") and line.count("\n") == 1
        assert not out.exists() and not list(tmp_path.glob(".unfinished*"))
        return line

    return refuse


@pytest.mark.parametrize(
    "arguments, named",
    [
        (["--trials", 0], "--trials"),
        (["--trials", -3], "--trials"),
        (["--seed", -1], "--seed"),
        (["--seed", 2**32], "--seed"),
        (["--world", "nowhere"], "nowhere"),
        (["--world", "fig07"], "fig07"),
        (["--noise", "missing.json"], "missing.json"),
    ],
)
def test_simulate_refuses_bad_options(refused, arguments, named):
    assert named in refused("simulate", *arguments)


@pytest.mark.parametrize(
    "content",
    [
        None,
        b"",
        b"\x89PNG\0\0\0",
        b"hello\nworld\n",
        b"ODOM 0 0 0 0 0 0 1.0 host 1.0\nODOM 1 0 0 0 0 0 2.0 host 2.0\n",
        b"FLASER 3 1 1 1\n",
    ],
    ids=["missing", "empty", "binary", "no log", "no scans", "no odometry"],
)
def test_run_refuses_what_is_no_log(refused, tmp_path, content):
    log = tmp_path / "some.clf"
    if content is not None:
        log.write_bytes(content)
    assert str(log) in refused("run", log)


def test_run_refuses_a_log_in_which_no_beam_hits_anything(refused, tmp_path):
    log = tmp_path / "blind.clf"
    rows = (f"{'200 ' * 181}{t} 0 0 {t} 0 0 {t}.5 host {t}.5" for t in range(3))
    log.write_text("".join(f"FLASER 181 {row}\n" for row in rows))
    line = refused("run", log)
    assert f"{log}: ranges: no beam of 3 scans hit anything" in line


@pytest.mark.parametrize("option", ["--reference", "--relations", "--noise"])
def test_run_refuses_bad_side_files(refused, tmp_path, option):
    bad = tmp_path / "bad.txt"
    bad.write_text("1 2 three\n")
    assert f"{bad}:1" in refused("run", write_log(tmp_path / "a.clf"), option, bad)


def test_run_refuses_a_reference_of_another_time(refused, tmp_path):
    other = tmp_path / "other.tum"
    tum.write(other, 1e6 + np.arange(SCANS), drive()[0])
    line = refused("run", write_log(tmp_path / "a.clf"), "--reference", other)
    assert str(other) in line and "clocks" in line


def test_results_cannot_replace_a_file(tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    assert main.main(["simulate", "--out", str(tmp_path / "out")]) == 2
    assert str(tmp_path / "out") in capsys.readouterr().err
    assert (tmp_path / "out").read_text() == "mine"


def test_an_interrupt_leaves_nothing_behind(tmp_path, capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(simulate_command, "enable_caches", lambda: None)
    monkeypatch.setattr(drives, "num_scans_of_drive", stop)
    assert main.main(["simulate", "--out", str(tmp_path / "out")]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_programs_compiled_in_parallel_count_once():
    assert _covered([]) == 0.0
    assert _covered([(5.0, 6.0), (0.0, 2.0), (1.0, 3.0), (1.5, 2.5)]) == 4.0


def test_the_package_exports_what_it_says_and_not_much():
    assert len(jaxslam.__all__) <= 20
    assert all(hasattr(jaxslam, name) for name in jaxslam.__all__)


def test_relative_poses_of_numpy_agree_with_jax():
    a, b = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, -2.0]]), np.array([[0.0, 5.0, -3.0], [1.0, 1, 1]])
    expected = jax.vmap(se2.compose)(a, jnp.asarray(relative(a, b)))
    np.testing.assert_allclose(expected, b, atol=1e-12)
