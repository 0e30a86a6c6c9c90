"""Reader of a tree of values, TOML or JSON."""

import json
import re
import tomllib
from os import PathLike
from typing import Any

from jaxslam.io import strict_json
from jaxslam.io.errors import InputError
from jaxslam.io.text import lines


def read(path: str | PathLike, advice: str) -> dict[str, Any]:
    """Tree of a file, JSON by its name or its first character, TOML otherwise.

    Args:
        path: The file.
        advice: What to do with a file that is refused.

    Raises:
        InputError: The file cannot be read, or is neither.
    """
    data = b"".join(line for _, line in lines(path))
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        raise InputError("is not UTF-8", path=path, advice="save it as UTF-8") from None
    if str(path).lower().endswith(".json") or text.lstrip().startswith("{"):
        try:
            found = strict_json.parse(text)
        except json.JSONDecodeError as error:
            problem = f"is not JSON ({error.msg})"
            raise InputError(problem, path=path, line=error.lineno, advice=advice) from None
        except ValueError as error:
            raise InputError(f"is not JSON ({error})", path=path, advice=advice) from None
        except RecursionError:
            raise InputError("is nested too deep", path=path, advice=advice) from None
        if not isinstance(found, dict):
            raise InputError("is no JSON object", path=path, advice=advice)
        return found
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        place = re.search(r" \(at line (\d+), column \d+\)$", str(error))
        problem = f"is not TOML ({str(error)[: place.start()] if place else error})"
        line = int(place[1]) if place else None
        raise InputError(problem, path=path, line=line, advice=advice) from None
    except RecursionError:
        raise InputError("is nested too deep", path=path, advice=advice) from None
