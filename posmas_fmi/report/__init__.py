"""The report of a run: one self-contained HTML file from the stored results."""

from __future__ import annotations

from pathlib import Path

from posmas_fmi.writing import whole

__all__ = ["write_report"]


def write_report(folder: Path) -> Path:
    """Write ``report.html`` from the stored results of a run, or of a comparison.

    A folder whose ``summary.json`` compares controllers of a cooling row gets the page of key
    figures, a single cooling run the report of the run and, beside it, the key figures as
    ``kpi.html``. The same files give the same bytes. The pages need no network.

    Parameters
    ----------
    folder : Path
        Holds ``results.nc``, ``design.json``, ``summary.json`` and ``manifest.json``. A run that
        was cut off may lack ``summary.json``. A comparison holds ``summary.json`` and a folder
        per controller.

    Returns
    -------
    Path
        The report, in the same folder.

    Raises
    ------
    InputError
        If a file is missing or cannot be used; names the file and what to do.
    ResultsError
        If the report cannot be written.

    Examples
    --------
    >>> write_report(Path("no-such-run"))
    Traceback (most recent call last):
        ...
    posmas_fmi.errors.InputError: no-such-run: expected the folder of a run (there is none); ...
    """
    from posmas_fmi.report.kpi_data import has_kpis

    kpis = has_kpis(folder)
    if kpis and not (folder / "results.nc").is_file():
        return _write(folder / "report.html", _kpi_page(folder))
    from posmas_fmi.report.page import render
    from posmas_fmi.report.reading import read_run

    page = render(read_run(folder), kpis)
    if kpis:
        _write(folder / "kpi.html", _kpi_page(folder))
    return _write(folder / "report.html", page)


def _kpi_page(folder: Path) -> str:
    from posmas_fmi.report.kpi_data import read_kpis
    from posmas_fmi.report.kpi_page import render

    return render(read_kpis(folder))


def _write(path: Path, page: str) -> Path:
    with whole(path) as file:
        file.write(page)
    return path
