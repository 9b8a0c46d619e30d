"""The folder of a run as one `Run`."""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np

from posmas_fmi.errors import InputError
from posmas_fmi.report.data import AgentVerdict, Run, Summary
from posmas_fmi.report.foreign import number
from posmas_fmi.report.json_files import design_facts, read_json, summary_facts
from posmas_fmi.report.results_file import read_results

_NO_SUMMARY = Summary("", "", (), None, None, None, None, None, {}, ())


def read_run(folder: Path) -> Run:
    """Read the folder of a run.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    Run

    Raises
    ------
    InputError
        If a file is missing or cannot be used.
    """
    if not folder.is_dir():
        came = "a file" if folder.exists() else "there is none"
        raise InputError(
            f"expected the folder of a run ({came}); make one with 'posmas-fmi run'", str(folder)
        )
    manifest = read_json(folder / "manifest.json")
    design = design_facts(read_json(folder / "design.json"), manifest, folder / "design.json")
    signals = read_results(folder / "results.nc")
    draft = Run(design=design, summary=_NO_SUMMARY, manifest=manifest, **signals)
    path = folder / "summary.json"
    if not draft.complete and not path.exists():
        return attrs.evolve(draft, summary=_derived_summary(draft))
    return attrs.evolve(draft, summary=summary_facts(read_json(path), path))


def _derived_summary(run: Run) -> Summary:
    error, estimation = run.final_error, run.estimation_error
    lost = np.isfinite(run.lost_at)
    return Summary(
        verdict="diverged" if lost.any() else "cut off",
        reason="",
        agents=tuple(
            AgentVerdict(name, "lost" if lost[i] else "cut off", number(error[i]))
            for i, name in enumerate(run.names)
        ),
        tracking_error=number(error.max()),
        estimation_error=(
            None
            if estimation is None or not len(run.time)
            else number(np.abs(estimation[-1]).max())
        ),
        min_state=number(np.nanmin(run.x)) if run.x is not None and run.x.size else None,
        wall_s=None,
        steps=round((run.until - run.time[0]) / run.period) if run.period and run.time.size else 0,
        comparison={},
        notes=(),
    )
