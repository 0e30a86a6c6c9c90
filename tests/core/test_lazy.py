import ast
import importlib
from pathlib import Path

import pytest

import jaxslam
import jaxslam.mapping

LAZY = ("core", "evaluation", "filtering", "io", "mapping", "matching", "pipeline", "study")


@pytest.mark.parametrize("package", LAZY)
def test_names_that_type_checkers_see_are_those_that_there_are(package):
    module = importlib.import_module(f"jaxslam.{package}")
    source = (Path(jaxslam.__file__).parent / package / "__init__.py").read_text()
    block = next(node for node in ast.parse(source).body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    seen = {alias.name: node.module for node in imports for alias in node.names}
    assert sorted(seen) == module.__all__
    for name, defined_in in seen.items():
        assert getattr(module, name) is getattr(importlib.import_module(defined_in), name)


def test_other_names_are_no_attributes():
    with pytest.raises(AttributeError, match="module 'jaxslam.mapping' has no attribute 'Rooms'"):
        _ = jaxslam.mapping.Rooms
