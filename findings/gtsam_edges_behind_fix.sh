#!/bin/sh
# GTSAM 4.3.0: readG2o reads no edge behind a line that it does not know, without a message.
#
# `FIX 0` is a line of the g2o format itself (g2o writes it for a fixed vertex), and lines that start
# with # are its comments. Vertices behind such a line are read, edges are not: a file with FIX
# between vertices and edges gives a graph without factors.
#
# Seen: edges alone 2 factors; FIX last 2; FIX before the edges 0; a comment before the edges 0.
# Exit status 0: it still behaves so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gtsam==4.3.0
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import gtsam

VERTICES = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_SE2 2 2 0 0\n"
EDGES = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 0 1 0 0 1 0 1\n"
FILES = {
    "edges alone": (VERTICES + EDGES, 2),
    "FIX last": (VERTICES + EDGES + "FIX 0\n", 2),
    "FIX before the edges": (VERTICES + "FIX 0\n" + EDGES, 0),
    "a comment before the edges": (VERTICES + "# odometry\n" + EDGES, 0),
}
changed = False
for name, (text, seen) in FILES.items():
    with open("graph.g2o", "w") as file:
        file.write(text)
    factors, values = gtsam.readG2o("graph.g2o", False)
    print(f"{name}: {factors.size()} factors, {values.size()} poses")
    changed |= factors.size() != seen or values.size() != 3
raise SystemExit("this has changed" if changed else 0)
PYTHON
