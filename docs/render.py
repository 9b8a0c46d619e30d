"""Execute the notebooks and write them as pages: `python docs/render.py [NAME...]`.

A notebook is `notebooks/NAME.py`, in jupytext's percent format. Its page `docs/notebooks/NAME.md`
holds text, code, what the code printed, and its figures beside the page. Edit the notebook, not
the page.
"""

from __future__ import annotations

import ast
import contextlib
import io
import re
import sys
from pathlib import Path
from typing import Any

import attrs

DOCS = Path(__file__).resolve().parent
NOTEBOOKS = DOCS.parent / "notebooks"
PAGES = DOCS / "notebooks"
NOTE = """---
hide: [toc]
---

<!-- Made by docs/render.py from notebooks/{name}.py: edit that, then run the script. -->

!!! note ""
    This page is the notebook `notebooks/{name}.py`, executed. To run it yourself, open it in
    Jupyter with the jupytext extension, or as a script in any editor that knows `# %%` cells.
"""


@attrs.frozen(eq=False)
class Figure:
    """A figure, and the titles of its plots."""

    png: bytes
    title: str


@attrs.frozen(eq=False)
class Cell:
    """One cell; `printed` and `figures` are what executing its code left."""

    kind: str  # "code" or "markdown"
    source: str
    printed: str = ""
    figures: tuple[Figure, ...] = ()


def main(names: list[str]) -> None:
    """Write the pages of these notebooks, of all without names."""
    for path in sorted(NOTEBOOKS.glob("*.py")):
        if not names or path.stem in names:
            write(path.stem, execute(read(path)))


def read(path: Path) -> list[Cell]:
    """Return the cells of a notebook, not executed."""
    import jupytext

    notebook = jupytext.read(path, fmt="py:percent")
    return [Cell(cell.cell_type, cell.source) for cell in notebook.cells]


def execute(cells: list[Cell]) -> list[Cell]:
    """Execute the code cells in turn, in one name space, as a kernel would."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    names: dict[str, Any] = {"__name__": "__main__"}
    done = []
    with mpl.rc_context():
        for cell in cells:
            done.append(_execute(cell, names) if cell.kind == "code" else cell)
            plt.close("all")
    return done


def _execute(cell: Cell, names: dict[str, Any]) -> Cell:
    import matplotlib.pyplot as plt

    body = ast.parse(cell.source).body
    last = body.pop() if body and isinstance(body[-1], ast.Expr) else None
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(ast.Module(body, []), "<cell>", "exec"), names)
        value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), names) if last else None
    if value is not None and not plt.get_fignums():  # plotting calls return what they drew
        print(value, file=printed)
    figures = []
    for number in plt.get_fignums():
        image, figure = io.BytesIO(), plt.figure(number)
        figure.savefig(image, format="png", metadata={"Software": None})
        titles = [axes.get_title() for axes in figure.axes]
        figures.append(Figure(image.getvalue(), "; ".join(filter(None, titles))))
    return attrs.evolve(cell, printed=printed.getvalue(), figures=tuple(figures))


# ---- pages ----------------------------------------------------------------------------------


def write(name: str, cells: list[Cell]) -> None:
    """Write the page of an executed notebook and its figures."""
    PAGES.mkdir(exist_ok=True)
    for old in PAGES.glob(f"{name}-*.png"):
        old.unlink()
    figures = [figure for cell in cells for figure in cell.figures]
    for k, figure in enumerate(figures, 1):
        (PAGES / f"{name}-{k}.png").write_bytes(figure.png)
    (PAGES / f"{name}.md").write_text(page(name, cells), encoding="utf-8", newline="\n")


def page(name: str, cells: list[Cell]) -> str:
    """Return the page of an executed notebook."""
    parts, number = [NOTE.format(name=name)], 0
    for cell in cells:
        if cell.kind != "code":
            parts.append(f"{cell.source}\n")
            continue
        parts.append(f"```python\n{cell.source}\n```\n")
        if cell.printed.strip():
            parts.append(f"```text\n{cell.printed.rstrip()}\n```\n")
        for figure in cell.figures:
            number += 1
            parts.append(f"![Figure {number}: {figure.title}]({name}-{number}.png)\n")
    return "\n".join(parts)


def source_of(text: str) -> list[str]:
    """Return the code cells that a page shows."""
    return re.findall(r"^```python\n(.*?)\n```$", text, re.S | re.M)


if __name__ == "__main__":
    main(sys.argv[1:])
