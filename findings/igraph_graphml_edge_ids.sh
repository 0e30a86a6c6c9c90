#!/bin/sh
# igraph 1.0.0 (Python): edges read from GraphML have the ids of nodes as their attribute `id`.
#
# Each <edge> of the file has an id of its own. Read_GraphML joins the right nodes and reads the
# right data, but the attribute `id` of the edges is filled with the ids of nodes, in the order of
# the file, and with empty strings when these run out.
#
# Seen: edges with the ids e10, e20, e30, e40 and nodes a, b, c: ids a, b, c and ''.
# Exit status 0: it still behaves so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet igraph==1.0.0
cd "$folder"
cat > graph.graphml <<'GRAPHML'
<?xml version="1.0" encoding="UTF-8"?>
<graphml xmlns="http://graphml.graphdrawing.org/xmlns">
  <key id="number" for="edge" attr.name="number" attr.type="int"/>
  <graph edgedefault="undirected">
    <node id="a"/>
    <node id="b"/>
    <node id="c"/>
    <edge id="e10" source="a" target="b"><data key="number">10</data></edge>
    <edge id="e20" source="b" target="c"><data key="number">20</data></edge>
    <edge id="e30" source="c" target="a"><data key="number">30</data></edge>
    <edge id="e40" source="a" target="b"><data key="number">40</data></edge>
  </graph>
</graphml>
GRAPHML
"$folder/venv/bin/python" - <<'PYTHON'
import igraph

graph = igraph.Graph.Read_GraphML("graph.graphml")
for edge in graph.es:
    ends = [graph.vs[k]["id"] for k in edge.tuple]
    print(f"edge {edge['number']:.0f} of {'-'.join(ends)}: id {edge['id']!r}")
changed = graph.es["id"] != ["a", "b", "c", ""] or graph.es["number"] != [10, 20, 30, 40]
raise SystemExit("this has changed" if changed else 0)
PYTHON
