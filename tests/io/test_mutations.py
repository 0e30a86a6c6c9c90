"""Files of every kind, damaged at random: each is read, or refused in one clear line."""

import gzip
import resource
import warnings
import zipfile

import layouts
import numpy as np
import pytest
import test_carmen
import test_g2o
import test_geojson_properties
import test_map_file
import test_mrclam
import test_npz
import test_ros_bags
import test_ros_map
from PIL import Image

from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import (
    geojson,
    map_file,
    mrclam,
    noise_file,
    npz,
    readers,
    relations,
    ros_map,
    tum,
)
from jaxslam.io.errors import InputError

COUNT = 160  # damaged files of each kind
MEMORY = 2**20  # [kB] that reading them all may take beyond what the tests had before
HUGE = (b"1e999", b"-1e308", b"9" * 400, b"nan", b"-inf", b"1e-320", b"0", b"-1", b"", b"x\xff\x00")


def damaged(data, rng):
    """The bytes of a file with one to three things wrong."""
    for _ in range(rng.integers(1, 4)):
        data = DAMAGES[rng.integers(len(DAMAGES))](data, rng)
    return data


def place(data, rng):
    return int(rng.integers(len(data) + 1))


def flip(data, rng):
    changed = bytearray(data)
    for _ in range(rng.integers(1, 20)):
        if changed:
            changed[rng.integers(len(changed))] = rng.integers(256)
    return bytes(changed)


def cut(data, rng):
    return data[: place(data, rng)]


def take_out(data, rng):
    a, b = sorted((place(data, rng), place(data, rng)))
    return data[:a] + data[b:]


def put_in(data, rng):
    a = place(data, rng)
    return data[:a] + rng.bytes(rng.integers(1, 50)) + data[a:]


def swap_lines(data, rng):
    lines = data.split(b"\n")
    a, b = rng.integers(len(lines), size=2)
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


def repeat_line(data, rng):
    lines = data.split(b"\n")
    a, b = rng.integers(len(lines), size=2)
    return b"\n".join([*lines[:a], *[lines[b]] * int(rng.integers(1, 5)), *lines[a:]])


def join_lines(data, rng):
    lines = data.split(b"\n")
    a = rng.integers(len(lines))
    return b"\n".join([*lines[:a], b" ".join(lines[a : a + 2]), *lines[a + 2 :]])


def change_field(data, rng):
    lines = data.split(b"\n")
    a = rng.integers(len(lines))
    fields = lines[a].split(b" ")
    fields[rng.integers(len(fields))] = HUGE[rng.integers(len(HUGE))]
    lines[a] = b" ".join(fields)
    return b"\n".join(lines)


def drop_field(data, rng):
    lines = data.split(b"\n")
    a = rng.integers(len(lines))
    fields = lines[a].split(b" ")
    del fields[rng.integers(len(fields))]
    lines[a] = b" ".join(fields)
    return b"\n".join(lines)


def write_otherwise(data, rng):
    other = ("utf-16", "utf-32", "cp037")[rng.integers(3)]
    return data.decode("latin-1").encode(other, errors="replace")


DAMAGES = (flip, flip, cut, take_out, put_in, swap_lines, repeat_line, join_lines, change_field)
DAMAGES += (change_field, drop_field, write_otherwise)


def text(path, lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def zipped(path, lines):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("graph.g2o", "\n".join(lines) + "\n")
    return path


def gzipped(path, lines):
    path.write_bytes(gzip.compress(("\n".join(lines) + "\n").encode()))
    return path


def lasers():
    still = [test_g2o.laser(reads, 100.0 + i) for i, reads in enumerate(test_g2o.ranges())]
    return [line.replace(" 1 2 3 ", f" {k} 2 3 ") for k, line in enumerate(still)]


def raw_lasers():
    """RAWLASER1 lines between ODOM lines, after the parameters of the mount."""
    beams = "1.0 2.0 3.0 4.0 5.0"
    scan = f"RAWLASER1 0 -1.0 2.0 0.5 8.0 0.01 0 5 {beams} 0"
    lines = ["PARAM robot_frontlaser_offset 0.25 0 host 0"]
    for t in range(12):
        lines += [test_carmen.odom(t), f"{scan} {t} host {t}"]
    return lines


def bag(path, ros):
    test_ros_bags.write(path, ros, scans=3)
    return next(path.glob("*.db3")) if ros == 2 else path


def metadata(path):
    test_ros_bags.write(path, 2, scans=3)
    return path / "metadata.yaml"


def arrays(path):
    npz.write(path, test_npz.laser_log())
    return path


def saved(path):
    map_file.write(path, test_map_file.saved_map())
    return path


def picture(path):
    fields = "".join(f"{name}: {value}\n" for name, value in test_ros_map.FIELDS.items())
    path.write_text(fields)
    Image.fromarray(np.tile(test_ros_map.SHADES, (4, 4))).save(path.with_suffix(".pgm"))
    return path


def noise(path):
    noise_file.write(path, NoiseParams.for_laser_log())
    return path


def read_noise(path):
    return noise_file.read(path, NoiseParams.for_laser_log())


def parent(path):
    return readers.read_log(path.parent)


def read_robot(path):
    return mrclam.read(path.parent, 1)


def map_of(path):
    return ros_map.read(path.with_suffix(".yaml"))


def annotated(path):
    geojson.write(path, test_geojson_properties.NODES, test_geojson_properties.ARCS)
    test_geojson_properties.edit(path, test_geojson_properties.give)
    return path


def next_map(path):
    """Whatever is read can be written again."""
    test_geojson_properties.next_session(path)


# How a good file is made, given the path of a new one, and how it is read, given that of the file.
KINDS = {
    "drive.clf": (lambda p: text(p, test_carmen.good(12)), readers.read_log),
    "drive.clf.gz": (lambda p: gzipped(p, test_carmen.good(12)), readers.read_log),
    "drive.log": (lambda p: text(p, lasers()), readers.read_log),
    "raw.log": (lambda p: layouts.player(p, layouts.messages()[:30]), readers.read_log),
    "old.log": (lambda p: layouts.player(p, layouts.messages()[:30], old=True), readers.read_log),
    "bare.clf": (
        lambda p: layouts.carmen(p, layouts.messages()[:30], poses=False),
        readers.read_log,
    ),
    "raw.clf": (lambda p: text(p, raw_lasers()), readers.read_log),
    "graph.g2o": (lambda p: text(p, test_g2o.graph()), readers.read_log),
    "graph.zip": (lambda p: zipped(p, test_g2o.graph()), readers.read_log),
    "drive.npz": (arrays, readers.read_log),
    "drive.bag": (lambda p: bag(p, 1), readers.read_log),
    "drive": (lambda p: bag(p, 2), readers.read_log),
    "described": (metadata, parent),
    "map.npz": (saved, map_file.read),
    "map.geojson": (annotated, next_map),
    "map.yaml": (picture, ros_map.read),
    "map.pgm": (lambda p: picture(p.with_suffix(".yaml")).with_suffix(".pgm"), map_of),
    "drive.tum": (lambda p: text(p, ["0.5 1 2 0 0 0 0.6 0.8"] * 5), tum.read),
    "all.relations": (lambda p: text(p, ["1 2 0.5 0.25 0 0 0 0.125"] * 5), relations.read),
    "noise.json": (noise, read_noise),
    "Robot1_Measurement.dat": (
        lambda p: test_mrclam.save(p.parent / "set") / p.name,
        read_robot,
    ),
}


@pytest.mark.timeout(120)
@pytest.mark.parametrize("name", KINDS)
def test_damaged_files_are_read_or_refused_in_one_line(name, tmp_path):
    make, read = KINDS[name]
    path = make(tmp_path / name)
    whole = path.read_bytes()
    read(path)  # a good one is read
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused = 0
    for seed in range(COUNT):
        data = damaged(whole, np.random.default_rng([seed, len(whole)]))
        path.write_bytes(data)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read(path)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and len(str(error)) < 600, (seed, error)
    assert refused > 0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEMORY
