"""``[compare]``: the same plant, loads, faults and random numbers under several controllers."""

from __future__ import annotations

import json
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import attrs

from posmas_fmi.cosim.master import Progress
from posmas_fmi.design import Design
from posmas_fmi.errors import InputError, ScenarioError
from posmas_fmi.scenario.build import Scenario
from posmas_fmi.scenario.folder import occupied
from posmas_fmi.scenario.job import (
    RunResult,
    extras,
    make_design_of,
    make_law,
    run_designed,
    write_json,
)
from posmas_fmi.scenario.plant import fmu_files, make_instances
from posmas_fmi.scenario.resume import forget_snapshots
from posmas_fmi.scenario.tables import CompareTable, ControlTable

_LOOK = 0.2  # s between two looks at the runs
PRACTICE = "pi"
LEFT = ("summary.json", "manifest.json", "design.json", "report.html", "results.nc", "results.csv")
ENDED = ("failed", "cancelled", "diverged")  # before the end of the run


def controllers(scenario: Scenario) -> dict[str, ControlTable]:
    """Return the controllers that are compared, by name.

    Raises
    ------
    ScenarioError
        If a name is given twice, cannot be a folder, or is neither a law nor in ``[controllers]``.
    """
    compare = scenario.compare
    assert compare is not None
    from posmas_fmi.cooling.control import CONTROLLERS
    from posmas_fmi.scenario.cooling import PREDICTIVE

    found: dict[str, ControlTable] = {}
    problems = []
    laws = ("protocol", *((*CONTROLLERS, PREDICTIVE) if scenario.cooling is not None else ()))
    for k, name in enumerate(compare.controllers):
        place = f"$.compare.controllers[{k}]"
        if name in found:
            problems.append((place, f"{name!r} is given twice"))
        elif name in scenario.controllers and name.replace("_", "").replace("-", "").isalnum():
            found[name] = scenario.controllers[name]
        elif name in laws:
            found[name] = ControlTable(name)
        else:
            known = ", ".join((*scenario.controllers, *laws))
            problems.append((place, f"there is no controller {name!r}; expected one of {known}"))
    if not compare.controllers:
        problems.append(("$.compare.controllers", "expected at least one controller"))
    if compare.practice is not None and compare.practice not in compare.controllers:
        text = f"expected one of the controllers (got {compare.practice!r})"
        problems.append(("$.compare.practice", text))
    if compare.processes is not None and compare.processes < 1:
        problems.append(("$.compare.processes", "expected a whole number >= 1"))
    if problems:
        raise ScenarioError(tuple(problems), str(scenario.path))
    return found


def run_comparison(
    scenario: Scenario,
    folder: Path,
    progress: Callable[[str], Progress | None] = lambda label: None,
    command: str = "",
    report: bool = True,
) -> RunResult:
    """Run a scenario under each of its controllers, several at once, and set them side by side.

    Parameters
    ----------
    scenario : Scenario
        With ``[compare]``.
    folder : Path
        Gets a folder for each controller, ``summary.json`` and the page of key figures.
    progress : callable, optional
        As in `posmas_fmi.scenario.main_job.run`; steps are counted over all runs.
    command : str, optional
    report : bool, optional

    Returns
    -------
    RunResult

    Raises
    ------
    PosmasError
        If the controllers are not known, or one of the runs could not be started.
    """
    from posmas_fmi.report import write_report

    compare, began = scenario.compare, time.perf_counter()
    assert compare is not None
    tables = controllers(scenario)
    designed = make_design_of(scenario)
    single = attrs.evolve(scenario, compare=None)
    runs = {name: attrs.evolve(single, control=table) for name, table in tables.items()}
    for name, one in runs.items():
        with _placed(scenario, name):
            make_law(one, designed)
            make_instances(one, fmu_files(one), extras(one))
    with occupied(folder):
        steps = scenario.clock.steps
        shown = progress("compare")
        summaries = _all(scenario, runs, designed, folder, command, report, steps, shown)
        summary = together(summaries, compare)
        summary["wall_s"] = round(time.perf_counter() - began, 3)
        write_json(folder / "summary.json", summary)
        first = folder / next(iter(runs))
        manifest = json.loads((first / "manifest.json").read_text(encoding="utf-8"))
        write_json(folder / "manifest.json", manifest | {"controllers": list(runs)})
        if report and summary.get("kpi"):
            write_report(folder)
        return RunResult(folder, designed, summary, designed.certificate.certified)


@contextmanager
def _placed(scenario: Scenario, name: str) -> Iterator[None]:
    """Let errors about the law of a run name the table of its controller."""
    place = f"$.controllers.{name}" if name in scenario.controllers else "$.control"
    try:
        yield
    except InputError as error:
        where = error.where.replace("$.control", place, 1)
        raise InputError(error.message, where) from error.__cause__


def _all(
    scenario: Scenario,
    runs: dict[str, Scenario],
    designed: Design,
    folder: Path,
    command: str,
    report: bool,
    steps: int,
    progress: Progress | None,
) -> dict[str, dict[str, Any]]:
    """Run all controllers in processes of their own; return their summaries."""
    context = multiprocessing.get_context("spawn")
    done = context.Array("q", len(runs), lock=False)
    wanted = scenario.compare.processes if scenario.compare is not None else None
    workers = min(len(runs), wanted or os.cpu_count() or 1)
    with ProcessPoolExecutor(workers, context, _share, (done,)) as pool:
        futures: dict[str, Future[dict[str, Any]]] = {
            name: pool.submit(_one, k, one, designed, folder / name, command, report)
            for k, (name, one) in enumerate(runs.items())
        }
        try:
            pending = set(futures.values())
            while pending:
                ended, pending = wait(pending, _LOOK)
                for name in [name for name, future in futures.items() if future in ended]:
                    with _placed(scenario, name):
                        futures[name].result()  # an error of one run ends the comparison at once
                if progress is not None and sum(done):
                    progress(sum(done), steps * len(runs))
        except BaseException:
            for future in futures.values():
                future.cancel()
            for process in (pool._processes or {}).values():
                process.terminate()
            raise
    return {name: future.result() for name, future in futures.items()}


_done: Any = None  # in a worker process: steps done, of each run


def _share(done: Any) -> None:
    global _done
    _done = done


def _one(
    number: int, scenario: Scenario, designed: Design, folder: Path, command: str, report: bool
) -> dict[str, Any]:
    def count(done: int, total: int) -> None:
        _done[number] = done

    def started() -> None:
        """Give up what an earlier comparison, or a plain run, left above: this run begins."""
        for name in LEFT:
            (folder.parent / name).unlink(missing_ok=True)
        forget_snapshots(folder.parent)

    made = run_designed(
        scenario, designed, folder, lambda label: count, command, report, started=started
    )
    return made.summary


def together(summaries: dict[str, dict[str, Any]], compare: CompareTable) -> dict[str, Any]:
    """Return the summary of a comparison from those of its runs.

    Parameters
    ----------
    summaries : dict of str to dict
        By controller.
    compare : CompareTable

    Returns
    -------
    dict
        ``verdict`` is ``compared``, or what kept a run from its end, or from being one of the
        coupled system.
    """
    stopped = [
        (name, one["verdict"] if one["verdict"] in ENDED else "not settled")
        for name, one in summaries.items()
        if one["verdict"] in ENDED or one.get("unsettled_steps")
    ]
    first = next(iter(summaries.values()))
    shared = ("kpi", "limits", "facility_K", "band_K", "scenario", "created_by", "faults")
    practice = PRACTICE if PRACTICE in summaries else None
    return {
        "verdict": stopped[0][1] if stopped else "compared",
        "reason": "; ".join(f"{name}: {verdict}" for name, verdict in stopped),
        **{key: first[key] for key in shared if key in first},
        "practice": compare.practice or practice,
        "comparison": {
            name: {
                "verdict": one["verdict"],
                **next(iter(one.get("comparison", {}).values()), _figures(one)),
            }
            for name, one in summaries.items()
        },
        "tracking_error_final": max(
            (one["tracking_error_final"] or 0) for one in summaries.values()
        ),
        "min_state": min((one["min_state"] or 0) for one in summaries.values()),
        "steps": first["steps"],
    }


def _figures(one: dict[str, Any]) -> dict[str, Any]:
    """Return what is compared of runs that are no cooling."""
    return {
        key: one[key] for key in ("tracking_error_final", "estimation_error_final", "min_state")
    }
