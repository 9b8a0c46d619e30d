"""The report of a run: one self-contained HTML file from the stored results."""

from __future__ import annotations

from pathlib import Path

from posmas_fmi.errors import InputError

__all__ = ["write_report"]


def write_report(folder: Path) -> Path:
    """Write ``report.html`` from the stored results of a run.

    The same files give the same bytes. The page needs no network and runs no script.

    Parameters
    ----------
    folder : Path
        Holds ``results.nc``, ``design.json``, ``summary.json`` and ``manifest.json``. A run that
        was cut off may lack ``summary.json``.

    Returns
    -------
    Path
        The report, in the same folder.

    Raises
    ------
    InputError
        If a file is missing or cannot be used; names the file and what to do.

    Examples
    --------
    >>> write_report(Path("no-such-run"))
    Traceback (most recent call last):
        ...
    posmas_fmi.errors.InputError: no-such-run: expected the folder of a run (there is none); ...
    """
    from posmas_fmi.report.page import render
    from posmas_fmi.report.reading import read_run

    page = render(read_run(folder))
    path = folder / "report.html"
    try:
        path.write_text(page, encoding="utf-8", newline="\n")
    except OSError as error:
        raise InputError(
            f"cannot write the report ({error.strerror}); make the folder writable", str(path)
        ) from error
    return path
