"""The notebooks run, and their pages show what they are."""

import runpy
import tempfile
from pathlib import Path

import pytest

import posmas_fmi

ROOT = Path(posmas_fmi.__file__).resolve().parent.parent
pytestmark = pytest.mark.skipif(
    not (ROOT / "notebooks").is_dir(), reason="the notebooks are in the checkout only"
)
NAMES = sorted(path.stem for path in (ROOT / "notebooks").glob("*.py"))
AGAIN = "out of date: python docs/render.py {}"


@pytest.fixture(scope="module")
def render():
    return runpy.run_path(str(ROOT / "docs" / "render.py"))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs_and_its_page_has_its_figures(name, render, monkeypatch, tmp_path):
    """What a notebook claims, it asserts itself."""
    monkeypatch.chdir(tmp_path)
    done = render["execute"](render["read"](ROOT / "notebooks" / f"{name}.py"))
    assert list(tmp_path.iterdir()) == [], "a notebook leaves nothing behind"
    figures = sum(len(cell.figures) for cell in done)
    shown = sorted((ROOT / "docs" / "notebooks").glob(f"{name}-*.png"))
    assert len(shown) == figures >= 3, AGAIN.format(name)
    page = (ROOT / "docs" / "notebooks" / f"{name}.md").read_text(encoding="utf-8")
    assert all(f"({path.name})" in page for path in shown), AGAIN.format(name)


@pytest.mark.parametrize("name", NAMES)
def test_the_page_shows_text_and_code_of_the_notebook(name, render):
    cells = render["read"](ROOT / "notebooks" / f"{name}.py")
    page = (ROOT / "docs" / "notebooks" / f"{name}.md").read_text(encoding="utf-8")
    code = [cell.source for cell in cells if cell.kind == "code"]
    assert render["source_of"](page) == code, AGAIN.format(name)
    for cell in cells:
        assert cell.source in page, AGAIN.format(name)
    assert tempfile.gettempdir() not in page, "a place of one machine"


def test_every_page_belongs_to_a_notebook():
    pages = {path.stem for path in (ROOT / "docs" / "notebooks").glob("*.md")}
    assert pages == {*NAMES}


def test_what_is_printed_and_drawn_is_kept(render):
    cell = render["Cell"]
    cells = [
        cell("markdown", "# Title"),
        cell("code", "import matplotlib.pyplot as plt\nx = 2\nprint('hello')\nx + 1"),
        cell("code", 'plt.plot([x])\nplt.gca().set_title("Two")'),
    ]
    done = render["execute"](cells)
    assert done[1].printed == "hello\n3\n"
    assert done[2].figures[0].png.startswith(b"\x89PNG")
    page = render["page"]("demo", done)
    assert render["source_of"](page) == [cells[1].source, cells[2].source]
    assert "```text\nhello\n3\n```" in page
    assert "![Figure 1: Two](demo-1.png)" in page
    with pytest.raises(ZeroDivisionError):
        render["execute"]([cell("code", "1 / 0")])
