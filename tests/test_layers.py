"""The tree of packages: arrows point one way, only viz draws, everything is installed."""

import ast
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest

import jaxslam

HOME = Path(next(iter(jaxslam.__path__)))
PACKAGES = (
    "core frontend matching filtering smoothing mapping localisation pipeline evaluation "
    "simulation tuning io study viz cli"
).split()
FILES = sorted(HOME.rglob("*.py"))
MAX_LINES = 350


def package(path: Path) -> str:
    """Package that a file belongs to; empty for the files of the root."""
    return path.relative_to(HOME).parts[0] if path.parent != HOME else ""


def imported(source: str) -> list[str]:
    """Full names of all that a source text imports, wherever it does."""
    nodes = list(ast.walk(ast.parse(source)))
    plain = [a.name for n in nodes if isinstance(n, ast.Import) for a in n.names]
    froms = [n for n in nodes if isinstance(n, ast.ImportFrom)]
    assert not any(n.level for n in froms), "imports name the package in full"
    return plain + [f"{n.module}.{a.name}" for n in froms for a in n.names]


def upstream(source: str) -> set[str]:
    """Packages of jaxslam that a source text imports."""
    return {name.split(".")[1] for name in imported(source) if name.startswith("jaxslam.")}


def modules_upstream(source: str) -> set[str]:
    """Modules of jaxslam, `package.module`, that a source text imports from."""
    parts = [name.split(".")[1:] for name in imported(source) if name.startswith("jaxslam.")]
    return {".".join(p[:2]) for p in parts if (HOME / p[0] / f"{p[1]}.py").is_file()}


def test_imports_are_found_in_every_form():
    source = """
import jaxslam.core.scan
from jaxslam.frontend import segments, features as f
from jaxslam.io.text import rows
def late():
    import matplotlib.pyplot as plt
    from jaxslam.mapping.routes import Route
"""
    assert upstream(source) == {"core", "frontend", "io", "mapping"}
    assert "matplotlib.pyplot" in imported(source)


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(HOME)))
def test_packages_import_only_what_comes_before(path):
    name = package(path)
    if name:
        assert name in PACKAGES, f"{name} has no place in the order of the packages"
        assert upstream(path.read_text()) <= set(PACKAGES[: PACKAGES.index(name) + 1])


def test_modules_of_a_package_do_not_import_each_other_in_circles():
    after = {
        ".".join(path.relative_to(HOME).with_suffix("").parts): modules_upstream(path.read_text())
        for path in FILES
        if package(path) and path.stem != "__init__"
    }
    while ready := {name for name, needs in after.items() if not needs & after.keys()}:
        after = {name: needs for name, needs in after.items() if name not in ready}
    assert not after, f"circular imports among {sorted(after)}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(HOME)))
def test_only_viz_imports_matplotlib(path):
    drawn = [name for name in imported(path.read_text()) if name.split(".")[0] == "matplotlib"]
    assert not drawn or package(path) == "viz"


def test_import_of_the_package_loads_no_plotting():
    code = (
        "import sys, jaxslam; jaxslam.Config; jaxslam.run_slam; print('matplotlib' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(HOME)))
def test_files_are_short_enough_to_read(path):
    assert len(path.read_text().splitlines()) <= MAX_LINES


def test_public_names_are_few_and_all_there():
    assert dir(jaxslam) == sorted(jaxslam.__all__) and len(jaxslam.__all__) <= 20
    assert all(getattr(jaxslam, name) is not None for name in jaxslam.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Log'"):
        _ = jaxslam.Log


def test_tests_mirror_the_packages():
    folders = {path.name for path in Path(__file__).parent.iterdir() if path.is_dir()}
    assert set(PACKAGES) <= folders


def test_all_packages_and_their_readmes_are_installed():
    """The tests run on the sources, where a package that is left out of the wheel is not missed."""
    project = tomllib.loads((HOME.parent / "pyproject.toml").read_text())["tool"]["setuptools"]
    include = project["packages"]["find"]["include"]
    packages = [file.parent.relative_to(HOME.parent) for file in HOME.rglob("__init__.py")]
    names = [".".join(path.parts) for path in packages]
    assert len(names) == len(PACKAGES) + 1
    assert all(any(fnmatch(n, x) for x in include) for n in names)
    assert {"README.md", "py.typed"} <= set(project["package-data"]["*"])
    assert all((HOME / name / "README.md").is_file() for name in PACKAGES)
