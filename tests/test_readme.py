"""READMEs: their examples run as a user runs them, their links lead somewhere, they stay short."""

import re
from pathlib import Path

import jax
import pytest

import jaxslam

HOME = Path(__file__).resolve().parents[1]
READMES = sorted(
    [HOME / "README.md", *HOME.glob("jaxslam/*/README.md"), *HOME.glob("experiments/*.md")]
)
SLOW = [
    "README.md",
    *(
        f"jaxslam/{name}/README.md"
        for name in ("simulation", "pipeline", "tuning", "localisation", "study")
    ),
]
LONGEST = {"README.md": 250, "jaxslam/cli/README.md": 90, "experiments/README.md": 90}
PROGRAM_LINES = 15
BLOCKS = [
    pytest.param(
        path,
        number,
        text,
        id=f"{path.relative_to(HOME)}:{number}",
        marks=[pytest.mark.slow] if str(path.relative_to(HOME)) in SLOW else [],
    )
    for path in READMES
    for number, text in enumerate(re.findall(r"```python\n(.*?)```", path.read_text(), re.S))
]


def anchor(heading: str) -> str:
    """Anchor of a heading, as Markdown viewers make it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@pytest.mark.timeout(600)
@pytest.mark.parametrize(("path", "number", "text"), BLOCKS)
def test_examples_run_in_float32(path, number, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with (
        jax.enable_x64(False),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
    ):
        exec(compile(text, f"{path.relative_to(HOME)} block {number}", "exec"), {})


def test_three_programs_of_a_stranger_are_short_and_need_jaxslam_alone():
    blocks = [text for path, _, text in (b.values for b in BLOCKS) if path.parent == HOME]
    assert len(blocks) == 3
    for text in blocks:
        assert len(text.strip().splitlines()) <= PROGRAM_LINES
        imports = set(re.findall(r"from jaxslam(\S*) import", text))
        assert imports == {""}
        names = re.search(r"from jaxslam import \(?([^)]*?)\)?\n(?!    )", text)[1]
        assert {n.strip() for n in names.split(",") if n.strip()} <= set(jaxslam.__all__)


@pytest.mark.parametrize("path", READMES, ids=lambda p: str(p.relative_to(HOME)))
def test_links_lead_somewhere(path):
    text = path.read_text()
    anchors = {anchor(h) for h in re.findall(r"(?m)^#+ (.*)$", text)}
    links = re.findall(r"\]\(([^)\s]+)\)", text)
    for link in links:
        if link.startswith("#"):
            assert link[1:] in anchors, link
        elif not re.match(r"https://", link):
            assert (path.parent / link.split("#")[0]).exists(), link


@pytest.mark.parametrize("path", READMES, ids=lambda p: str(p.relative_to(HOME)))
def test_readmes_are_short(path):
    assert len(path.read_text().splitlines()) <= LONGEST.get(str(path.relative_to(HOME)), 40)


def test_the_root_names_every_package():
    text = (HOME / "README.md").read_text()
    assert all(f"({path.relative_to(HOME)})" in text for path in READMES if path.parent != HOME)
