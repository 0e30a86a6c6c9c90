"""The XML of SVG drawings, made ready for svgelements."""

import re
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

from jaxslam.io.errors import InputError

SVG = "{http://www.w3.org/2000/svg}"
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
LENGTH = re.compile(rf"\s*({NUMBER})\s*(px|mm|cm|in|pt|pc|em|ex|%|)\s*$", re.IGNORECASE)
LENGTHS = "x y x1 y1 x2 y2 cx cy r rx ry width height".split()
FUNCTION = re.compile(r"([a-z]+)\s*\(([^()]*)\)", re.IGNORECASE)
ARGUMENTS = {"matrix": (6,), "translate": (1, 2), "scale": (1, 2), "rotate": (1, 3), "skew": (1, 2)}
ARGUMENTS |= {name + axis: (1,) for name in ("translate", "scale", "skew") for axis in "xy"}
"""How many numbers a transform of a name may have."""
UNITS = {"translate": "px", "rotate": "deg|rad|grad|turn", "skew": "deg|rad|grad|turn"}
"""Units of these that svgelements applies; with others it drops the shape."""
STYLED = re.compile(r"(?<![-\w])transform(-origin)?\s*:\s*([^;}]*)", re.IGNORECASE)
SHAPES = set("svg use line polyline polygon rect circle ellipse".split())
NOT_DRAWN = {f"{SVG}{tag}" for tag in ("symbol", "marker", "mask", "clipPath", "pattern")}
MAX_BYTES = 2**26
ADVICE = "save it as plain SVG"


def read(path: Path) -> ET.Element:
    """The XML tree of a file, ready for svgelements.

    What is drawn only where others refer to it is in definitions, the page has both sides if its
    `viewBox` and one side are known.

    Raises:
        InputError: The file cannot be read, is no SVG, or has a number, a list of points or a
            transform that is malformed, of which svgelements would read a part; or it uses a symbol
            that has a `viewBox`, or the origin of a transform, which svgelements does not apply.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise InputError("does not exist", path=path, advice="check the name") from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", path=path) from None
    if len(data) > MAX_BYTES:
        raise InputError(f"is larger than {MAX_BYTES >> 20} MiB", path=path, advice=ADVICE)
    if data[:2] == b"\x1f\x8b":
        raise InputError("is compressed", path=path, advice="unpack it: gunzip, and name it .svg")
    try:
        tree = ET.fromstring(data)
    except ET.ParseError as error:
        line = error.position[0]
        problem = f"is no XML ({error.msg.partition(':')[0]})"
        raise InputError(problem, path=path, line=line, advice=ADVICE) from None
    except (ValueError, LookupError):  # of its encoding
        raise InputError("is no XML", path=path, advice=ADVICE) from None
    if tree.tag == "svg":  # without its namespace
        for item in tree.iter():
            if isinstance(item.tag, str) and not item.tag.startswith("{"):
                item.tag = SVG + item.tag
    if tree.tag != f"{SVG}svg":
        problem = f"is XML of <{tree.tag.rpartition('}')[2]:.20}>, not of <svg>"
        raise InputError(problem, path=path, advice=ADVICE)
    _check_attributes(path, tree)
    _hide_what_is_not_drawn(path, tree)
    _complete_page(tree)
    return tree


def _check_attributes(path: Path, tree: ET.Element) -> None:
    """Raise InputError if an attribute of the geometry is malformed."""
    for item in tree.iter():
        if not isinstance(item.tag, str) or not item.tag.startswith(SVG):
            continue
        tag = item.tag.removeprefix(SVG)
        wrong = [
            name
            for name, value in item.attrib.items()
            if name in LENGTHS
            and tag in SHAPES
            and not _is_length(value)
            or name == "points"
            and not _is_list_of_points(value)
        ]
        for name in wrong:
            problem = f"{item.get(name)!r:.60} is malformed"
            raise InputError(problem, path=path, field=f"<{tag}> {name}", advice="correct it")
        _check_transforms(path, item, tag)


def _check_transforms(path: Path, item: ET.Element, tag: str) -> None:
    """Raise InputError if a transform of an element is malformed, or has an origin of its own."""
    style = item.text or "" if tag == "style" else item.get("style", "")
    given = [("-origin" if origin else "", value) for origin, value in STYLED.findall(style)]
    given += [(k, item.get(f"transform{k}", "")) for k in ("", "-origin")]
    for kind, value in given:
        field = f"<{tag}> transform{kind}"
        if kind and value.strip(" 0px,"):  # not 0 0, which is the default
            problem = f"{value!r:.60} is not applied"
            advice = "write rotate(angle x y), or apply the transform to the shapes"
            raise InputError(problem, path=path, field=field, advice=advice)
        if not kind and not _is_transform(value):
            problem = f"{value!r:.60} is malformed"
            raise InputError(problem, path=path, field=field, advice="write numbers without units")


def _is_transform(value: str) -> bool:
    """Whether a text is a list of transforms whose numbers are all understood."""
    if value.strip() == "none":
        return True
    for name, arguments in FUNCTION.findall(value):
        units = next((own for key, own in UNITS.items() if name.lower().startswith(key)), "")
        rest, count = re.subn(rf"{NUMBER}(?:{units})?", " ", arguments)
        if count not in ARGUMENTS.get(name.lower(), ()) or rest.replace(",", " ").strip():
            return False
    return not FUNCTION.sub(" ", value).replace(",", " ").strip()


def _is_length(value: str) -> bool:
    """Whether a text is a length; `auto` is one."""
    return value.strip() == "auto" or LENGTH.match(value) is not None


def _is_list_of_points(value: str) -> bool:
    """Whether a text is an even number of numbers."""
    rest, count = re.subn(NUMBER, " ", value)
    return count % 2 == 0 and not rest.replace(",", " ").strip()


def _hide_what_is_not_drawn(path: Path, tree: ET.Element) -> None:
    """Move elements that are drawn only where others refer to them into definitions.

    Raises:
        InputError: A symbol that is used has a `viewBox`, which svgelements does not apply.
    """
    used = set(_uses(tree))
    for item in tree.iter(f"{SVG}symbol"):
        if item.get("id") in used and item.get("viewBox"):
            problem = f"uses the symbol {item.get('id')!r:.40}, which has a viewBox"
            advice = "convert symbols to groups (Inkscape: Object, Symbols), or remove them"
            raise InputError(problem, path=path, advice=advice)
    for parent in list(tree.iter()):
        if parent.tag == f"{SVG}defs":
            continue
        for k, item in enumerate(parent):
            if item.tag in NOT_DRAWN:
                parent[k] = ET.Element(f"{SVG}defs")
                parent[k].append(item)


def _complete_page(tree: ET.Element) -> None:
    """Give a page with a `viewBox`, and a width or a height alone, the other one by its ratio."""
    try:
        _, _, *box = map(float, tree.get("viewBox", "").replace(",", " ").split())
    except ValueError:
        return  # refused later
    for known, missing, ratio in ("width", "height", (1, 0)), ("height", "width", (0, 1)):
        length = LENGTH.match(tree.get(known, ""))
        is_missing = tree.get(missing, "100%").strip().endswith("%")
        if length and is_missing and len(box) == 2 and min(box) > 0.0:
            value = float(length[1]) * box[ratio[0]] / box[ratio[1]]
            tree.set(missing, f"{value!r}{length[2]}")


def missing_uses(tree: ET.Element) -> Counter[str]:
    """How many elements of other files, or that do not exist, are used."""
    known = {f"{item.get('id')}" for item in tree.iter() if item.get("id")}
    return +Counter({"uses of what is not in the file": sum(n not in known for n in _uses(tree))})


def _uses(tree: ET.Element) -> list[str]:
    """Names of the elements that are used, once for each use."""
    return [
        value.removeprefix("#")
        for item in tree.iter(f"{SVG}use")
        for key, value in item.attrib.items()
        if key == "href" or key.endswith("}href")
    ]
