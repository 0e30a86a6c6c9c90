#!/bin/sh
# svgelements 1.9.6: the segments of Path(rect) are in another frame if the rect is turned or mirrored.
#
# Shapes of a drawing that SVG.parse has read come in CSS pixels: the transforms of the file and the
# scale of its viewBox are in their numbers. A rect that is turned, skewed or mirrored keeps its
# transform apart instead, and iterating Path(rect) does not apply it: the segments are those of the
# file, neither turned nor in pixels. The same outline as a path is right, and so is
# Path(rect).segments(transformed=True). Floor plans with turned cabinets lose them this way.
#
# Seen, of a drawing of 100 mm with a viewBox of 100: x of the rect 37.8 to 113.39 as it is, 10 to 30
# turned by 90 degrees or mirrored; 56.69 to 94.49 as a path, and with transformed=True.
# Exit status 0: it still behaves so.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet svgelements==1.9.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import io

import svgelements

HEAD = '<svg xmlns="http://www.w3.org/2000/svg" width="100mm" height="100mm" viewBox="0 0 100 100">'
RECT = '<rect x="10" y="10" width="20" height="10" {}/>'
TURN = 'transform="rotate(90 20 15)"'


def span(shape, transformed=None):
    """Least and greatest x of the only shape of a drawing."""
    drawing = svgelements.SVG.parse(io.StringIO(f"{HEAD}{shape}</svg>"))
    (found,) = (one for one in drawing.elements() if isinstance(one, svgelements.Shape))
    path = svgelements.Path(found)
    parts = path if transformed is None else path.segments(transformed=transformed)
    x = [float(part.end.x) for part in parts if part.end is not None]
    return round(min(x), 2), round(max(x), 2)


CASES = {
    "rect as it is": (span(RECT.format("")), (37.8, 113.39)),
    "rect turned": (span(RECT.format(TURN)), (10.0, 30.0)),
    "rect mirrored": (span(RECT.format('transform="scale(-1 1)"')), (10.0, 30.0)),
    "path turned": (span(f'<path d="M10 10H30V20H10Z" {TURN}/>'), (56.69, 94.49)),
    "rect turned, transformed=True": (span(RECT.format(TURN), True), (56.69, 94.49)),
}
for name, (found, _) in CASES.items():
    print(f"{name}: x {found[0]:g} to {found[1]:g}")
raise SystemExit("this has changed" if any(one != seen for one, seen in CASES.values()) else 0)
PYTHON
