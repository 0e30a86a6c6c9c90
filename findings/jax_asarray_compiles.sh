#!/bin/sh
# JAX 0.10.2: jnp.asarray of a NumPy array compiles a program for each shape and type.
#
# What only brings numbers to the device goes through `stage`, a jitted identity, and through
# `convert_element_type` where a dtype is given that differs. Both are compiled anew for each shape
# and type, 10 to 50 ms of a cold start each; a command line that converts fifty arrays of its input
# spends seconds on it. jax.device_put of the same arrays, converted by NumPy where that is wanted,
# compiles nothing.
#
# Seen, of six arrays of different shapes and types: 6 programs by jnp.asarray, 3 more by
# jnp.asarray(x, jnp.float32) of three float64 arrays, none by jax.device_put.
# Exit status 0: it still behaves so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet jax==0.10.2 jaxlib==0.10.2
cd "$folder"
JAX_PLATFORMS=cpu "$folder/venv/bin/python" - <<'PYTHON'
import jax
import jax.numpy as jnp
import numpy as np

compiled = []


def listen(event, duration, **_):
    if event.endswith("backend_compile_duration"):
        compiled.append(duration)


jax.monitoring.register_event_duration_secs_listener(listen)


def programs(convert, arrays):
    before = len(compiled)
    jax.block_until_ready([convert(x) for x in arrays])
    return len(compiled) - before


kinds = (np.float32, np.float64, np.int32, np.int64, bool, np.uint8)
arrays = [np.zeros((3, 5 + k), kind) for k, kind in enumerate(kinds)]
doubles = [np.zeros((7, 5 + k)) for k in range(3)]
counts = {
    "jax.device_put": programs(jax.device_put, arrays + doubles),
    "jnp.asarray": programs(jnp.asarray, arrays),
    "jnp.asarray(x, jnp.float32)": programs(lambda x: jnp.asarray(x, jnp.float32), doubles),
}
for name, count in counts.items():
    print(f"{name}: {count} programs")
changed = list(counts.values()) != [0, 6, 3]
raise SystemExit("this has changed" if changed else 0)
PYTHON
