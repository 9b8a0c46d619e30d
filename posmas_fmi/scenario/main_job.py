"""What is done with a scenario: one run, or one for each of its controllers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import attrs

from posmas_fmi.cosim.master import Progress
from posmas_fmi.errors import InputError
from posmas_fmi.scenario.build import Scenario
from posmas_fmi.scenario.compare import controllers, run_comparison
from posmas_fmi.scenario.job import RunResult, extras, make_design_of, run_designed
from posmas_fmi.scenario.plant import fmu_files, make_instances
from posmas_fmi.scenario.schedule import Schedule, schedule_of


def run(
    scenario: Scenario,
    folder: Path,
    progress: Callable[[str], Progress | None] = lambda label: None,
    command: str = "",
    report: bool = True,
    resume: bool = False,
    branch: tuple[Path, float] | None = None,
) -> RunResult:
    """Run a scenario and write everything to a folder.

    Parameters
    ----------
    scenario : Scenario
    folder : Path
        Made if needed; files of an earlier run in it are replaced.
    progress : callable, optional
        Gets a label, returns a progress function for that part or None.
    command : str, optional
        For the manifest.
    report : bool, optional
        Whether to write report.html as well.
    resume : bool
        Go on with the run in the folder, which ended early: from its last snapshot, or, without
        one, from its start.
    branch : (Path, float), optional
        Folder of another run and the time [s] of one of its snapshots, from which this one begins.

    Returns
    -------
    RunResult

    Raises
    ------
    PosmasError
        If nothing could be run. A run that diverges or whose FMU fails is no error but a verdict,
        and what was recorded is kept.
    """
    integral = scenario.design.method == "integral" or scenario.design.K_q is not None
    if integral and scenario.cooling is None:
        raise InputError(
            "a run simulates the protocol without integrals: 'design' and 'certify' work for this "
            'method, and the law "integral" of a cooling row runs such gains',
            "$.design.method",
        )
    if scenario.compare is not None:
        if resume or branch:
            raise InputError("a comparison cannot go on; run one of its controllers", "$.compare")
        return run_comparison(scenario, folder, progress, command, report)
    make_instances(scenario, fmu_files(scenario), extras(scenario))  # its mistakes come first
    designed = make_design_of(scenario)
    return run_designed(
        scenario, designed, folder, progress, command, report, resume=resume, branch=branch
    )


def scheduled(scenario: Scenario) -> Schedule:
    """Return what a run of a scenario will do; of a comparison, that with its first controller.

    Raises
    ------
    PosmasError
        As `posmas_fmi.scenario.schedule.schedule_of`.
    """
    if scenario.compare is not None:
        control = next(iter(controllers(scenario).values()))
        scenario = attrs.evolve(scenario, compare=None, control=control)
    return schedule_of(scenario, extras(scenario))
