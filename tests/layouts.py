"""One drive, written in every layout of logs, with stamps that are wrong in every manner.

The writers are independent of the readers: plain text, NumPy, and rosbags' own.
"""

from typing import NamedTuple

import numpy as np
from bag_messages import START as BAG_START
from bag_messages import Maker
from rosbags import rosbag1, rosbag2

from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import relative
from jaxslam.io import npz, ros_bags

START, STEP, SCANS, BEAMS = 1.0e9 + 0.25, 0.2, 60, 8
LIDAR = Lidar(BEAMS, -np.pi / 2, np.pi / BEAMS, 12.0, 0.02)
FIELD = (BEAMS - 1) * np.pi / BEAMS


class Message(NamedTuple):
    """A scan or a pose of the wheels, with its own stamp and that of its reception [s]."""

    kind: str
    own: float
    received: float
    data: np.ndarray


def pose_at(t):
    """A drive of 0.5 m/s with turns, seconds after the start."""
    return np.array([0.5 * t, np.sin(0.5 * t), 0.6 * np.sin(0.4 * t)])


def true_poses():
    return np.array([pose_at(STEP * i) for i in range(SCANS)])


def true_times():
    return START + STEP * np.arange(SCANS)


def true_ranges():
    return np.random.default_rng(3).uniform(0.5, 9.0, (SCANS, BEAMS)).round(2).astype(np.float32)


def messages():
    """Wheels at each scan and between scans, in order of time."""
    said = []
    for i, ranges in enumerate(true_ranges()):
        t = STEP * i
        said.append(Message("odometry", START + t, START + t, pose_at(t)))
        said.append(Message("scan", START + t, START + t, ranges))
        t += STEP / 2
        said.append(Message("odometry", START + t, START + t, pose_at(t)))
    return said


def carmen(path, said, *, poses=True):
    """A CARMEN log; scans carry the pose of the wheels before them, or none."""
    lines, pose = [], np.zeros(3)
    for kind, own, received, data in said:
        tail = f"{own:.6f} host {received:.6f}"
        numbers = " ".join(repr(float(x)) for x in data)
        if kind == "odometry":
            pose = data
            lines.append(f"ODOM {numbers} 0 0 0 {tail}")
        else:
            where = " ".join(repr(float(x)) for x in pose)
            lines.append(f"FLASER {BEAMS} {numbers} {f'{where} {where} ' if poses else ''}{tail}")
    path.write_text("\n".join(lines) + "\n")
    return path


def player(path, said, *, old=False):
    """A log of the Player server, of version 2 or older, whose angles are in degrees."""
    lines = ["## Player version 2.1.0", "## File version 0.3.0", "## Format:"]
    unit = np.degrees(1.0) if old else 1.0
    for kind, own, _, data in said:
        head = f"{own:.6f} 16777343 6665 "
        kinds = "" if old else " 001 001"
        if kind == "odometry":
            name = "position" if old else "position2d"
            pose = f"{data[0]!r} {data[1]!r} {data[2] * unit!r} 0 0 0 0"
            lines.append(
                f"{head}{name} 00{kinds} {pose.replace('np.float64(', '').replace(')', '')}"
            )
        else:
            low, high, step = (
                repr(float(x * unit)) for x in (-np.pi / 2, FIELD - np.pi / 2, np.pi / BEAMS)
            )
            most = "" if old else f" {LIDAR.range_max}"
            beams = " ".join(f"{r:.2f} 0" for r in data)
            lines.append(f"{head}laser 00{kinds} {low} {high} {step}{most} {BEAMS} {beams}")
    lines.append("0.0 16777343 6665 laser 00 004 001 0 0 0 0.1 0.1 7")  # a reply, not data
    path.write_text("\n".join(lines) + "\n")
    return path


def bag(path, said, ros=2):
    """A bag; `seconds` of the stamps are relative to the start, as its maker takes them."""
    make = Maker(ros)
    shift = BAG_START
    writer = rosbag2.Writer(path, version=9) if ros == 2 else rosbag1.Writer(path)
    pack = make.store.serialize_cdr if ros == 2 else make.store.serialize_ros1
    types = {"odometry": ("/odom", ros_bags.ODOMETRY), "scan": ("/scan", ros_bags.SCAN)}
    with writer:
        known = {
            kind: writer.add_connection(topic, name, typestore=make.store)
            for kind, (topic, name) in types.items()
        }
        for kind, own, received, data in said:
            if kind == "odometry":
                message = make.odometry(own - shift, data)
            else:
                message = make.scan(
                    own - shift, data, first=LIDAR.angle_min, step=np.pi / len(data)
                )
            content = pack(message, types[kind][1])
            writer.write(known[kind], int(round(1e9 * received)), content)
    return path


def g2o(path, said):
    """A pose graph: a vertex per scan, edges between them by the wheels."""
    scans = [message for message in said if message.kind == "scan"]
    lines = []
    for i, (_, own, received, data) in enumerate(scans):
        beams = " ".join(repr(float(x)) for x in data)
        head = f"ROBOTLASER1 0 {LIDAR.angle_min!r} {FIELD} {LIDAR.angle_increment!r} 12.0 0.1 0"
        tail = f"0 1 2 3 4 5 6 0.1 0.2 0.3 0.4 0.5 {own:.6f} host {received:.6f}"
        lines += [f"VERTEX_SE2 {i} 0 0 0", f"{head} {BEAMS} {beams} {tail}"]
    poses = true_poses()
    for i, move in enumerate(relative(poses[:-1], poses[1:]).tolist()):
        lines.append(f"EDGE_SE2 {i} {i + 1} {' '.join(map(repr, move))} 1 0 0 1 0 1")
    path.write_text("\n".join(lines) + "\n")
    return path


def array_file(path, said):
    """A NumPy file of scans and poses."""
    np.savez(
        path, format=npz.FORMAT, version=npz.VERSION, odometry=true_poses(),
        times=[m.own for m in said if m.kind == "scan"], ranges=true_ranges(),
        first=LIDAR.angle_min, step=LIDAR.angle_increment, reach=LIDAR.range_max,
    )  # fmt: skip
    return path


LAYOUTS = {
    "carmen.clf": carmen,
    "bare.clf": lambda path, said: carmen(path, said, poses=False),
    "player.log": player,
    "old-player.log": lambda path, said: player(path, said, old=True),
    "one.bag": lambda path, said: bag(path, said, 1),
    "two": bag,
    "graph.g2o": g2o,
    "drive.npz": array_file,
}
"""By name of the file: what writes it."""

STREAMS = ["bare.clf", "player.log", "old-player.log", "one.bag", "two"]
"""Layouts whose scans have no poses of their own."""
