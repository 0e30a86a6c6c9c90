"""Rooflines of parts whose cost is given; the probes run on small arrays."""

import json

import numpy as np
import pytest

from experiments import common, roofline

GIVEN = {"flops_per_s": 1e11, "memory_bytes_per_s": 1e10, "cache_bytes_per_s": 1e11}
GIVEN |= {"dispatch_s": 1e-7}


def row(us, flops, size, name="front_end"):
    part = {"part": name, "us_per_scan": us, "operations": 10.0}
    return roofline.with_bounds({**part, "flops": flops, "bytes": size}, GIVEN)


@pytest.mark.parametrize(
    "us, flops, size, bound, fraction",
    [
        (100.0, 1e6, 1e4, "peak", 0.1),  # 100 operations a byte; 10 us at the peak
        (100.0, 1e4, 5e5, "memory", 0.5),  # 50 us at the bandwidth of memory
        (25.0, 1e4, 5e5, "cache", 0.2),  # faster than memory; 5 us at that of the cache
        (25.0, 1e6, 5e5, "peak", 0.4),  # faster than memory, too, but 10 us at the peak
        (100.0, 0.0, 5e5, "memory", 0.5),
    ],
)
def test_the_bound_is_the_least_that_holds(us, flops, size, bound, fraction):
    found = row(us, flops, size)
    assert found["bound"] == bound and found["fraction_of_bound"] == pytest.approx(fraction)
    roofs = (min(1e11, flops / size * speed) for speed in (1e10, 1e11))
    for kind, roof in zip(("memory", "cache"), roofs, strict=True):
        if flops:
            reached = found["flops_per_s"] / roof
            assert found[f"fraction_of_{kind}_bound"] == pytest.approx(reached)
    assert 0.0 < found["fraction_of_cache_bound"] <= found["fraction_of_memory_bound"]
    assert found["fraction_of_dispatch"] == pytest.approx(10 * 0.1 / us)


def test_a_part_of_unknown_cost_has_no_bound():
    found = row(100.0, None, None)
    assert found["fraction_of_dispatch"] == pytest.approx(0.01)
    assert all(found[key] is None for key in roofline.KEYS[:-1])


def test_the_table_and_the_picture_have_each_part(capsys, tmp_path):
    rows = [row(100.0, 1e6, 1e4), row(1.0, None, None, "a: b"), row(25.0, 1e4, 5e5, "c")]
    roofline.print_table(rows, GIVEN)
    first, head, *lines = capsys.readouterr().out.splitlines()
    assert "100 Gflop/s, 10.0 GB/s" in first and head.split()[0] == "roofline"
    assert [line[26:].split() for line in lines] == [
        ["10", "0.1", "100", "peak", *"10.0 % 10.0 % 10.0 % 1.0 %".split()],
        [*7 * "-", *"100.0 %".split()],
        ["0.4", "20", "0.02", "cache", *"20.0 % 200.0 % 20.0 % 4.0 %".split()],
    ]
    figure, axes = common.canvas(4, 3, 1, 1)
    roofline.draw(axes[0, 0], [*rows, row(25.0, 1e4, 5e5, "c: d")], GIVEN)
    *roofs, low, high = (line.get_xydata() for line in axes[0, 0].lines)
    np.testing.assert_allclose([*low, *high], [(0.02, 0.4), (100.0, 10.0)])
    assert all(np.diff(roof[:2, 1]) > 0.0 and roof[1, 1] == roof[2, 1] == 100 for roof in roofs)
    assert [text.get_text().strip() for text in axes[0, 0].texts] == ["c", "front end"]
    figure.savefig(tmp_path / "roofline.png")


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(roofline, "MATRIX", 64)
    monkeypatch.setattr(roofline, "DISPATCHED", (4, 3))
    monkeypatch.setattr(roofline, "TURNS_BYTES", 1 << 16)


def test_the_core_is_measured_by_xla_and_by_c_where_it_compiles(quick, monkeypatch, tmp_path):
    found = roofline.machine(1, memory=1 << 16)
    assert json.loads(json.dumps(found)) == found and found["dispatch_s"] > 0.0
    for name in roofline.CEILINGS:
        speeds = [found[kind].get(name, 0.0) for kind in ("c", "xla")]
        assert found[name] == max(speeds) > 0.0
        assert (speeds[0] > 0.0) is ("note" not in found["c"])
    monkeypatch.setattr(roofline, "C_SOURCE", tmp_path / "none.c")
    found = roofline.machine(1, memory=1 << 16)
    assert "none.c" in found["c"]["note"]
    assert all(found[name] == found["xla"][name] for name in roofline.CEILINGS)


def test_caches_are_read_where_the_system_says_them(monkeypatch, tmp_path):
    monkeypatch.setattr(roofline, "CACHES", tmp_path)
    assert roofline.cache_bytes() == (roofline.L2_BYTES, roofline.LAST_BYTES)
    for index, (level, size) in enumerate([("1", "48K"), ("2", "2048K"), ("3", "8192K")]):
        (tmp_path / f"index{index}").mkdir()
        (tmp_path / f"index{index}" / "level").write_text(f"{level}\n")
        (tmp_path / f"index{index}" / "size").write_text(f"{size}\n")
    assert roofline.cache_bytes() == (2 << 20, 8 << 20)
