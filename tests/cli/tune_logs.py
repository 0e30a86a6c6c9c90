"""Small logs that `jaxslam tune` is tested on, and how far a tuning is."""

import numpy as np

from jaxslam.cli.tune_command import CHECKPOINT_FILE
from jaxslam.core import se2

START = 1248272000.125  # [s]
LANDMARKS = {6: (3.0, 1.0), 7: (-2.5, 3.0), 8: (0.5, -2.5), 9: (0.0, 5.0)}
RANGE, BEARING = 0.05, 0.02  # [m], [rad] noise of the measurements


def write_mrclam(folder, *, robots=5, seconds=20.0, reference=True, seed=0):
    """A data set of robots that drive circles past landmarks, with noisy odometry."""
    folder.mkdir(parents=True)
    rng, h = np.random.default_rng(seed), 0.25

    def save(name, rows):
        (folder / name).write_text("".join(" ".join(map(str, row)) + "\n" for row in rows))

    save("Barcodes.dat", [(subject, 10 * subject) for subject in (1, 2, *LANDMARKS)])
    save("Landmark_Groundtruth.dat", [(i, *place, 0, 0) for i, place in LANDMARKS.items()])
    times = (START + np.arange(0.0, seconds, h)).tolist()
    for robot in range(1, robots + 1):
        commands = rng.uniform([0.2, -0.1], [0.8, 0.6], (len(times), 2))
        speeds = commands + rng.normal(size=commands.shape) * [0.04, 0.08] / np.sqrt(h)
        poses = [np.array([0.0, 0.0, robot])]
        for v, turn in speeds[:-1] * h:
            step = np.array([v * np.cos(turn / 2), v * np.sin(turn / 2), turn])
            poses.append(np.asarray(se2.compose(poses[-1], step)))
        save(f"Robot{robot}_Odometry.dat", [(t, *x) for t, x in zip(times, commands, strict=True)])
        if reference:
            known = [(t, *x) for t, x in zip(times, poses, strict=True)]
            save(f"Robot{robot}_Groundtruth.dat", known)
        measured = []
        for t, pose in list(zip(times, poses, strict=True))[2::2]:
            for i in rng.choice(list(LANDMARKS), 2, replace=False).tolist():
                dx, dy = np.array(LANDMARKS[i]) - pose[:2]
                bearing = np.arctan2(dy, dx) - pose[2] + rng.normal(0, BEARING)
                measured.append((t, 10 * i, np.hypot(dx, dy) + rng.normal(0, RANGE), bearing))
        save(f"Robot{robot}_Measurement.dat", measured)
    return folder


def scan(t, pose, beams=5):
    numbers = " ".join(f"{x:.3f}" for x in [2.0] * beams + [*pose] * 2)
    return f"FLASER {beams} {numbers} {t} host {t}\n"


def write_carmen(path, **options):
    path.write_text("".join(scan(t + 0.5, (0.1 * t, 0, 0), **options) for t in range(6)))
    return path


def evaluations(out):
    """Evaluations that the checkpoint of a tuning holds; 0 without one."""
    try:
        with open(out / CHECKPOINT_FILE, "rb") as file, np.load(file) as kept:
            return int(kept["leaf0"])
    except FileNotFoundError:
        return 0
