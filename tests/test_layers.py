import ast
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest

import jaxslam

HOME = Path(next(iter(jaxslam.__path__)))
ORDER = (
    "types poses linalg programs batches geometry world motion lidar grid voronoi tiles lines "
    "edges global_edges circles nodes sensor noise junctions links alignment closures association "
    "covariance belief conditioning ekf recognition arrow ways topomap medial skeleton slam "
    "smoother sparse online plan metrics monte_carlo losses descent fit curvature io logs mapping "
    "plot report options tuning film view cli"
).split()
DOORS = {"__init__", "__main__"}  # may import everything
FILES = sorted(HOME.rglob("*.py"))


def layer(path):
    """Module of the package, or subpackage, that a file belongs to."""
    return Path(path.relative_to(HOME).parts[0]).stem


def imported(source):
    """Full names of all that a source text imports, wherever it does."""
    nodes = list(ast.walk(ast.parse(source)))
    plain = [a.name for n in nodes if isinstance(n, ast.Import) for a in n.names]
    froms = [n for n in nodes if isinstance(n, ast.ImportFrom)]
    assert not any(n.level for n in froms), "imports name the package in full"
    return plain + [f"{n.module}.{a.name}" for n in froms for a in n.names]


def upstream(source):
    """Modules and subpackages of the package that a source text imports."""
    return {name.split(".")[1] for name in imported(source) if name.startswith("jaxslam.")}


def test_imports_are_found_in_every_form():
    source = """
import jaxslam.lidar
from jaxslam import edges, nodes as n
from jaxslam.io.text import rows
def late():
    import matplotlib.pyplot as plt
    from jaxslam.grid import Grid
"""
    assert upstream(source) == {"lidar", "edges", "nodes", "io", "grid"}
    assert "matplotlib.pyplot" in imported(source)


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(HOME)))
def test_modules_import_only_what_comes_before(path):
    name = layer(path)
    if name not in DOORS:
        assert name in ORDER, f"{name} has no place in the order of the modules"
        before = set(ORDER[: ORDER.index(name)])
        inside = {name} if path.parent != HOME else set()
        assert upstream(path.read_text()) <= before | inside


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(HOME)))
def test_only_plot_imports_matplotlib(path):
    drawn = [name for name in imported(path.read_text()) if name.split(".")[0] == "matplotlib"]
    assert not drawn or layer(path) == "plot"


def test_all_packages_are_installed():
    """The tests run on the sources, where a package that is left out of the wheel is not missed."""
    told = tomllib.loads((HOME.parent / "pyproject.toml").read_text())
    include = told["tool"]["setuptools"]["packages"]["find"]["include"]
    packages = [file.parent.relative_to(HOME.parent) for file in HOME.rglob("__init__.py")]
    names = [".".join(path.parts) for path in packages]
    assert len(names) >= 3 and all(any(fnmatch(n, x) for x in include) for n in names)
