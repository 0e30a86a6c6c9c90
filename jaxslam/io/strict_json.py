"""Reader of JSON that can be written again as it is: no NaN, no key twice, not nested too deep."""

import json
import math
from collections import Counter
from os import PathLike
from typing import Any

from jaxslam.io.errors import InputError

MAX_BYTES = 2**26  # of a file
MAX_DEPTH = 64  # of nested objects and arrays
MAX_DIGITS = 300  # of a number: any such integer is a float, too


def read(path: str | PathLike, advice: str) -> Any:
    """Read a file.

    Args:
        path: The file.
        advice: What to do with a file that is refused.

    Returns:
        Its content, or None if there is no such file; an empty dict for null.

    Raises:
        InputError: The file cannot be read, is larger than `MAX_BYTES`, no UTF-8, no JSON as
            RFC 8259 has it, or nested more than `MAX_DEPTH` deep; or a key is twice in an object.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        problem = f"cannot be read ({error.strerror})"
        raise InputError(problem, path=path, advice="check its permissions") from None
    if len(data) > MAX_BYTES:
        problem = f"is larger than {MAX_BYTES >> 20} MiB"
        raise InputError(problem, path=path, advice=advice)
    try:
        content = parse(data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError("is not UTF-8", path=path, advice="save it as UTF-8") from None
    except json.JSONDecodeError as error:
        problem = f"is not JSON ({error.msg})"
        raise InputError(problem, path=path, line=error.lineno, advice=advice) from None
    except ValueError as error:
        raise InputError(f"is not JSON ({error})", path=path, advice=advice) from None
    except RecursionError:
        problem = f"is nested more than {MAX_DEPTH} deep"
        raise InputError(problem, path=path, advice=advice) from None
    return {} if content is None else content


def parse(text: str) -> Any:
    """Value of a JSON text.

    Raises:
        ValueError: It is no JSON, or cannot be written again as it is.
        RecursionError: It is nested more than `MAX_DEPTH` deep.
    """

    def refuse(token: str) -> Any:
        raise ValueError(f"{token} is no number of JSON")

    def number(token: str) -> float | int:
        if len(token) > MAX_DIGITS:
            raise ValueError(f"a number has {len(token)} digits")
        return float(token) if math.isfinite(float(token)) else refuse(token)

    def integer(token: str) -> int:
        return int(token) if len(token) <= MAX_DIGITS else int(number(token))

    def distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            twice, _ = Counter(key for key, _ in pairs).most_common(1)[0]
            raise ValueError(f"an object has the key {twice[:40]!r} twice")
        return found

    value = json.loads(
        text,
        parse_constant=refuse,
        parse_float=number,
        parse_int=integer,
        object_pairs_hook=distinct,
    )
    if not _is_shallow(value):
        raise RecursionError
    return value


def _is_shallow(value: Any) -> bool:
    """Whether a value is nested no more than `MAX_DEPTH` deep."""
    level = [value]
    for _ in range(MAX_DEPTH):
        nested = [list(v.values()) if isinstance(v, dict) else v for v in level]
        level = [item for v in nested if isinstance(v, list) for item in v]
    return not level
