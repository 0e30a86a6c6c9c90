"""What the parts of the chain reach of what one core gives: the roofline.

No program is faster than its operations at the peak of the core, nor than its bytes at the
bandwidth of where they lie. Peak and bandwidths are measured: by a C program where there is a
compiler, and by programs of XLA; the faster of both counts. Operations and bytes are those of
XLA's analysis, in which all numbers are alike, whatever their type, and each operation reads its
operands anew. So a part whose batch stays in the cache may be above the bound of memory; then that
of the cache holds. On a CPU each operation of a compiled program is dispatched, too, which takes
a part of the time.
"""

import subprocess
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from experiments import common, peer_automata, program_depth
from experiments.common import Numbers
from experiments.timing import fastest

C_SOURCE = Path(__file__).with_suffix(".c")
CACHES = Path("/sys/devices/system/cpu/cpu0/cache")
L2_BYTES, LAST_BYTES = 1 << 20, 1 << 25  # where the system does not say
MOST_BYTES = 3 << 29  # of the arrays in memory
TURNS_BYTES = 1 << 28  # that a measurement of bandwidth moves at least
MATRIX = 1024  # rows of the product whose operations are timed
DISPATCHED = 64, 500  # sums in a turn, too many for one operation; turns of the loop
CEILINGS = ("flops_per_s", "memory_bytes_per_s", "cache_bytes_per_s")
KEYS = (
    *("flops_per_s", "bytes_per_s", "intensity", "bound"),
    *("fraction_of_bound", "fraction_of_memory_bound", "fraction_of_cache_bound"),
    "fraction_of_dispatch",
)
"""What `with_bounds` adds to a row."""


def cache_bytes() -> tuple[int, int]:
    """Bytes of the second cache of a core, and of its last."""
    sizes = {}
    for index in CACHES.glob("index*"):
        level, size = ((index / name).read_text().strip() for name in ("level", "size"))
        if size.endswith("K"):
            sizes[int(level)] = int(size[:-1]) << 10
    return sizes.get(2, L2_BYTES), sizes[max(sizes)] if sizes else LAST_BYTES


def by_c(memory: int, cache: int, repeats: int) -> Numbers:
    """`CEILINGS` by the C program, or a note why there are none.

    Args:
        memory: Bytes of the arrays that are larger than all caches.
        cache: Bytes of the arrays that stay in the second cache.
        repeats: Rounds, of which the fastest counts.
    """
    with tempfile.TemporaryDirectory() as folder:
        rival = peer_automata.compile_c(C_SOURCE, Path(folder), "-ffast-math")
        if rival.program is None:
            return {"note": rival.note}

        def run(size: int) -> float:
            command = [str(rival.program), str(size)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            return float(done.stdout.split()[0])

        best = [max(run(size) for _ in range(repeats)) for size in (0, memory, cache)]
    return dict(zip(CEILINGS, best, strict=True))


@partial(jax.jit, static_argnames="turns", donate_argnums=0)
def _add_often(a: jax.Array, b: jax.Array, *, turns: int) -> jax.Array:
    """`turns` sums of arrays in place: each reads two and writes one."""
    return lax.fori_loop(0, turns, lambda _, a: a + jnp.float32(1e-9) * b, a)


def _xla_bandwidth(size: int, repeats: int) -> float:
    """Bytes a second of sums of two arrays of `size` bytes in all."""
    count, turns = size // 8, 1 + TURNS_BYTES // size
    a, b = jnp.zeros(count, jnp.float32), jnp.ones(count, jnp.float32)

    def call() -> jax.Array:
        nonlocal a
        a = _add_often(a, b, turns=turns)
        return a

    return 12 * count * turns / fastest({"": (call,)}, repeats=repeats)[""]


def by_xla(memory: int, cache: int, repeats: int) -> Numbers:
    """`CEILINGS` by programs of XLA, and seconds to dispatch an operation."""
    matrix = jnp.ones((MATRIX, MATRIX), jnp.float32)
    product = jax.jit(lambda x: x @ x)
    sums, turns = DISPATCHED

    def turn(_: jax.Array, x: jax.Array) -> jax.Array:
        for _ in range(sums):
            x = x - jnp.sum(x)  # each sum waits for the one before
        return x

    loop = jax.jit(lambda x: lax.fori_loop(0, turns, turn, x))
    small = jnp.ones(4, jnp.float32)
    module = program_depth.parse(loop.lower(small).compile().as_text())
    taken = fastest({"product": (product, matrix), "loop": (loop, small)}, repeats=repeats)
    return {
        "flops_per_s": 2 * MATRIX**3 / taken["product"],
        "memory_bytes_per_s": _xla_bandwidth(memory, repeats),
        "cache_bytes_per_s": _xla_bandwidth(cache, repeats),
        "dispatch_s": taken["loop"] / program_depth.executed_operations(module),
    }


def machine(repeats: int, memory: int | None = None) -> Numbers:
    """What the core of this process gives: `CEILINGS`, `dispatch_s`, and those of each probe.

    Args:
        repeats: Rounds, of which the fastest counts.
        memory: Bytes of the arrays that are larger than all caches; by default four times the
            last cache.
    """
    second, last = cache_bytes()
    memory, cache = memory or min(4 * last, MOST_BYTES), second // 3
    c, xla = by_c(memory, cache, repeats), by_xla(memory, cache, repeats)
    best = {name: max(c.get(name, 0.0), xla[name]) for name in CEILINGS}
    arrays = {"memory_array_bytes": memory, "cache_array_bytes": cache}
    return {**best, "dispatch_s": xla["dispatch_s"], **arrays, "c": c, "xla": xla}


def with_bounds(row: dict[str, Any], given: Numbers) -> dict[str, Any]:
    """A row of `chain_profile` with `KEYS`; they are None where its cost is not known.

    `fraction_of_bound` is what it reaches of min(peak, intensity x bandwidth), and `bound` which
    that is: "peak", "memory", or "cache" where the bytes come faster than from memory. Beside it
    are the fractions with either bandwidth, and `fraction_of_dispatch`, the part of its time that
    dispatching takes.

    Args:
        row: Has `us_per_scan`, and of a scan `operations`, `flops` and `bytes`.
        given: Of `machine`.
    """
    seconds, flops, size = 1e-6 * row["us_per_scan"], row["flops"], row["bytes"]
    added: dict[str, Any] = dict.fromkeys(KEYS)
    added["fraction_of_dispatch"] = row["operations"] * given["dispatch_s"] / seconds
    if flops is not None and size:
        at_peak = flops / given["flops_per_s"]
        in_memory, in_cache = (size / given[f"{kind}_bytes_per_s"] for kind in ("memory", "cache"))
        of_memory, of_cache = (max(at_peak, x) / seconds for x in (in_memory, in_cache))
        bound = "cache" if in_memory > seconds else "memory"
        added |= {
            "flops_per_s": flops / seconds,
            "bytes_per_s": size / seconds,
            "intensity": flops / size,
            "bound": "peak" if at_peak >= (in_cache if bound == "cache" else in_memory) else bound,
            "fraction_of_bound": of_cache if bound == "cache" else of_memory,
            "fraction_of_memory_bound": of_memory,
            "fraction_of_cache_bound": of_cache,
        }
    return {**row, **added}


def print_table(rows: list[dict[str, Any]], given: Numbers) -> None:
    """Print what the core gives, and a line for each part."""
    gives = [given[name] / 1e9 for name in CEILINGS]
    print(
        "one core: {:.0f} Gflop/s, {:.1f} GB/s from memory, {:.0f} GB/s from the second cache, "
        "{:.2f} us to dispatch an operation".format(*gives, 1e6 * given["dispatch_s"])
    )
    names = ("Gflop/s", "GB/s", "flop/byte", "bound", "of it", "of memory's", "of cache's")
    names += ("dispatching",)
    print(f"{'roofline':26}" + "".join(f"{name:>13}" for name in names))
    for row in rows:
        rates = [row[key] and row[key] / 1e9 for key in KEYS[:2]] + [row["intensity"]]
        shown = ["-" if x is None else f"{x:.3g}" for x in rates] + [row["bound"] or "-"]
        shown += ["-" if row[key] is None else f"{100 * row[key]:.1f} %" for key in KEYS[4:]]
        print(f"{row['part']:26}" + "".join(f"{text:>13}" for text in shown))


def draw(axis: Any, rows: list[dict[str, Any]], given: Numbers) -> None:
    """Draw the roofs, and a point for each part that is none of another, on logarithmic axes."""
    found = [row for row in rows if row["intensity"] and ":" not in row["part"]]
    peak = given["flops_per_s"]
    first = min((row["intensity"] for row in found), default=1.0) / 10
    last = max([3 * peak / given["memory_bytes_per_s"], *(2 * row["intensity"] for row in found)])
    for kind, colour in (("cache", common.ORANGE), ("memory", common.BLUE)):
        speed = given[f"{kind}_bytes_per_s"]
        line = [first, peak / speed, last]
        roof = [min(peak, speed * x) / 1e9 for x in line]
        axis.plot(line, roof, color=colour, label=kind)
    found.sort(key=lambda row: row["flops_per_s"])
    for k, row in enumerate(found):  # names beside the axes, where they cannot overlap
        at = row["intensity"], row["flops_per_s"] / 1e9
        axis.plot(*at, ".", color=common.BLACK)
        axis.annotate(
            row["part"].replace("_", " "),
            at,
            xytext=(1.03, (k + 0.5) / len(found)),
            textcoords="axes fraction",
            fontsize=7,
            va="center",
            arrowprops={"arrowstyle": "-", "color": common.BLACK, "linewidth": 0.5},
        )
    axis.set(xscale="log", yscale="log", xlabel="operations a byte", ylabel="Gflop/s")
    axis.legend(fontsize=7, loc="upper left", frameon=False)
    axis.set_title("one core: roofline, and the parts of the chain", fontsize=10)
