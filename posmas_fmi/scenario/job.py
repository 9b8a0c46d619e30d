"""One run of a scenario, with its report: design, certify, co-simulate, record, judge."""

from __future__ import annotations

import hashlib
import json
import logging
import platform
import time
from collections.abc import Callable
from contextlib import ExitStack
from importlib import metadata
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.certify.certificate import Verdict
from posmas_fmi.cosim import engine
from posmas_fmi.cosim.conditions import Sensors
from posmas_fmi.cosim.failure import Leftover
from posmas_fmi.cosim.fmu_plant import FmuPlant
from posmas_fmi.cosim.law import Law, ProtocolLaw
from posmas_fmi.cosim.master import Iteration, Outcome, Progress, System
from posmas_fmi.cosim.recorder import Layout, Recorder, Thinned, write_csv
from posmas_fmi.design import Design, design
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.about import read_about
from posmas_fmi.fmu.scratch import sweep
from posmas_fmi.fmu.start_values import grouped
from posmas_fmi.fmu.start_values import told as start_value
from posmas_fmi.network import Network
from posmas_fmi.protocol import make_protocol
from posmas_fmi.scenario.build import Scenario, make_channel
from posmas_fmi.scenario.coverage import coverage
from posmas_fmi.scenario.faults import describe, make_crashes, make_episodes
from posmas_fmi.scenario.folder import occupied
from posmas_fmi.scenario.plant import Instances, fmu_files, make_instances, parameters, periods
from posmas_fmi.scenario.resume import Beginning, branched, forget_snapshots, resumed, snapshots
from posmas_fmi.scenario.schedule import make_schedule
from posmas_fmi.scenario.verdict import not_about, summarise
from posmas_fmi.writing import whole

log = logging.getLogger(__name__)

NEEDED = {"xhat", "u", "y", "s"}  # by the report
PACKAGES = ("posmas-fmi", "numpy", "scipy", "sympy", "fmpy", "h5netcdf", "h5py")


@attrs.frozen(eq=False)
class RunResult:
    """What a run left behind.

    Attributes
    ----------
    folder : Path
        With results.nc, design.json, manifest.json, summary.json, report.html.
    design : Design
    summary : dict
        As in summary.json.
    certified : {"yes", "conditional", "no"}
        Of what ran, as in design.json: the certificate of the design may be about another law. Of
        a comparison it is that of the design.
    """

    folder: Path
    design: Design
    summary: dict[str, Any]
    certified: Verdict

    @property
    def good(self) -> bool:
        """Whether the run converged (or all of a comparison ended) and is certified."""
        return self.summary["verdict"] in ("converged", "compared") and self.certified != "no"


def make_design_of(scenario: Scenario) -> Design:
    """Design the gains of a scenario, placing the pins first where it leaves them open.

    Raises
    ------
    PosmasError
        As `posmas_fmi.design.design`.
    """
    network, notes = pinned_network(scenario)
    made = design(scenario.agent, network, scenario.design, scenario.clock.h)
    return attrs.evolve(made, notes=(*notes, *made.notes))


def pinned_network(scenario: Scenario) -> tuple[Network, tuple[str, ...]]:
    """Return the network with its pins, placed where the scenario leaves them open, and notes.

    Raises
    ------
    NetworkError
        If so few pins cannot reach every agent.
    """
    if not scenario.pins:
        return scenario.network, ()
    from posmas_fmi.design.pinning import place

    placement = place(scenario.network, scenario.pins)
    network = scenario.network.with_pinned(placement.pinned)
    return network, (placement.note(network.names),)


def run_designed(
    scenario: Scenario,
    designed: Design,
    folder: Path,
    progress: Callable[[str], Progress | None] = lambda label: None,
    command: str = "",
    report: bool = True,
    resume: bool = False,
    branch: tuple[Path, float] | None = None,
    started: Callable[[], None] = lambda: None,
) -> RunResult:
    """Run a scenario with a design that is there already; see `posmas_fmi.scenario.main_job.run`.

    `started` is called when all FMUs run, before anything of an earlier run is given up.
    """
    designed = attrs.evolve(designed, network=law_network(scenario, designed))
    files = fmu_files(scenario)
    instances = make_instances(scenario, files, extras(scenario))
    if scenario.settings.coupling == "iterate":
        abouts = {path: read_about(path) for path in dict.fromkeys(files)}
        make_schedule(scenario, instances, [abouts[path] for path in files])
    system = make_system(scenario, designed, instances)
    choice = engine.choose(system.law, scenario.settings.engine, engine.unfit(system))
    told = manifest(scenario, files, choice, command)
    with occupied(folder):
        return _run_in(
            *(folder, scenario, designed, instances, choice, told, progress, report),
            *(resume, branch, started),
        )


def _run_in(
    folder: Path,
    scenario: Scenario,
    designed: Design,
    instances: Instances,
    choice: engine.Choice,
    told: dict[str, Any],
    progress: Callable[[str], Progress | None],
    report: bool,
    resume: bool,
    branch: tuple[Path, float] | None,
    begins: Callable[[], None],
) -> RunResult:
    """Simulate, judge and report in a folder that is held for it; `told` is the manifest."""
    from posmas_fmi.report import write_report

    sweep()
    beginning = Beginning()
    if resume:
        beginning = resumed(scenario, folder, told)
    elif branch is not None:
        beginning = branched(scenario, *branch, told)
    if beginning.branch:
        told["branch"] = beginning.branch
        scenario = attrs.evolve(scenario, baseline=False)  # it would begin at the start
    facts = facts_of(scenario, designed)

    def started(plant: FmuPlant) -> None:
        """All FMUs run: only now is what an earlier run left in the folder given up."""
        begins()
        for name in ("summary.json", "report.html", "results.csv"):
            (folder / name).unlink(missing_ok=True)
        if not resume:  # a run cut off from here on does not go on with what another one left
            (folder / "results.nc").unlink(missing_ok=True)
            forget_snapshots(folder)
        told["start_values"] = grouped(plant.start_values)
        write_json(folder / "design.json", facts)
        write_json(folder / "manifest.json", told)

    began = time.perf_counter()
    outcome, baseline, left = _simulate(
        scenario, designed, instances, choice, folder, progress, started, beginning
    )
    summary = summarise(outcome, scenario.network.names, scenario.settings.tolerance, left)
    if told["start_values"]:
        summary["messages"] = [start_value(finding) for finding in told["start_values"]]
    summary["coverage"] = coverage(scenario, designed)
    if scenario.faults:
        summary["faults"] = describe(
            list(scenario.faults),
            designed.network,
            scenario.clock,
            bool(designed.certificate.delays) and facts["certified"] != "no",
        )
    if baseline is not None:
        without = summarise(baseline, scenario.network.names, scenario.settings.tolerance)
        keys = ("verdict", "tracking_error_final", "min_state")
        summary["baseline"] = {key: without[key] for key in keys}
    if scenario.cooling is not None:
        from posmas_fmi.scenario.cooling import judge

        judge(scenario, designed, outcome, folder / "results.nc", summary)
    summary["wall_s"] = round(time.perf_counter() - began, 3)
    write_json(folder / "summary.json", summary)
    if scenario.record.csv:
        write_csv(folder / "results.nc", folder / "results.csv")
    missing = sorted(NEEDED.difference(scenario.record.variables))
    if report and missing:
        log.warning("no report: $.record.variables leaves %s out", ", ".join(missing))
    elif report:
        write_report(folder)
    return RunResult(folder, designed, summary, facts["certified"])


def facts_of(scenario: Scenario, designed: Design) -> dict[str, Any]:
    """Return what design.json holds: gains, and the certificate of the law that has them."""
    facts = {**designed.to_dict(), "sector": list(scenario.agent.sector)}
    if scenario.control.python is not None:
        facts |= not_about(f"controllers of one's own, {scenario.control.python!r}.")
    elif scenario.cooling is not None:
        from posmas_fmi.scenario.cooling import proved

        facts |= proved(scenario.control, designed)
    return facts


def _simulate(
    scenario: Scenario,
    designed: Design,
    instances: Instances,
    choice: engine.Choice,
    folder: Path,
    progress: Callable[[str], Progress | None],
    started: Callable[[FmuPlant], None],
    beginning: Beginning,
) -> tuple[Outcome, Outcome | None, tuple[Leftover, ...]]:
    """Run with the design, then once more without control for comparison.

    The last of the result is what the FMUs left behind in the run with the design.
    """
    recorded, baselines = tuple(scenario.record.variables), scenario.baseline
    with_baseline = baselines and "x" in recorded
    variables = (*recorded, "x_baseline") if with_baseline else recorded
    with ExitStack() as stack:
        plant = stack.enter_context(instances.start())
        started(plant)
        recorder = stack.enter_context(
            _recorder(scenario, designed.network, instances, folder, variables, beginning)
        )
        system = make_system(scenario, designed, instances)
        split, more = instances.recorded, _more(scenario, system.law)

        thinned = Thinned(recorder.add, scenario.record.every, beginning.k)

        def record(times: Array, values: dict[str, Array]) -> None:
            thinned({"time": times, **split.named(values), **more(times)})

        outcome = engine.run(
            system,
            plant,
            record,
            progress("simulate"),
            choice,
            scenario.settings.threads,
            variables=(*recorded, "extra"),
            snapshots=snapshots(scenario, folder, beginning),
        )
        thinned.finish()
        recorder.flush()
        baseline = None
        if baselines and outcome.ended in ("complete", "terminated", "diverged"):
            add = recorder.add if with_baseline else lambda values: None
            baseline = _without_control(
                scenario, designed, instances, choice, add, thinned.rows, progress
            )
        if outcome.ended in ("complete", "terminated"):
            recorder.finish()
    return outcome, baseline, plant.leftovers


def _without_control(
    scenario: Scenario,
    designed: Design,
    instances: Instances,
    choice: engine.Choice,
    add: Callable[[dict[str, Array]], None],
    points: int,
    progress: Callable[[str], Progress | None],
) -> Outcome:
    """Run with K = 0 and add x as a baseline, no further than the run it is compared with."""
    uncontrolled = attrs.evolve(designed, K=np.zeros_like(designed.K))
    thinned = Thinned(add, scenario.record.every)

    def record(times: Array, values: dict[str, Array]) -> None:
        if thinned.rows < points and "x" in values:
            thinned({"x_baseline": values["x"][: points - thinned.rows]})

    with instances.start(quiet=True) as plant:
        outcome = engine.run(
            make_system(scenario, uncontrolled, instances),
            plant,
            record,
            progress("without control"),
            choice,
            scenario.settings.threads,
            variables=("x",),
        )
    if thinned.rows == points:
        thinned.finish()
    return outcome


def _own_law(scenario: Scenario, designed: Design) -> Law:
    """Return controllers of the user's own."""
    from posmas_fmi.cosim.python_law import PythonLaw, load_class, make

    found = load_class(str(scenario.control.python), scenario.path.parent)
    given, N = scenario.control.parameters, designed.network.N
    controllers = (
        make(found, **given)
        if hasattr(found, "step_all")
        else [make(found, k + 1, **given) for k in range(N)]
    )
    every = periods(scenario)[:N].tolist()
    return PythonLaw(scenario.agent, designed.network, controllers, every, scenario.clock)


def make_law(scenario: Scenario, designed: Design) -> Law:
    """Return the controllers of the agents, as ``[control]`` says.

    Raises
    ------
    InputError
        If the law or a parameter is not known.
    """
    if scenario.control.python is not None:
        return _own_law(scenario, designed)
    if scenario.cooling is not None and scenario.control.law != "protocol":
        from posmas_fmi.scenario.cooling import cooling_law

        return cooling_law(scenario.control, scenario.cooling, designed)
    if scenario.control.law != "protocol" or scenario.control.parameters:
        raise InputError(
            f'expected "protocol", without parameters (got {scenario.control.law!r}); other laws '
            "need the table [cooling]",
            "$.control",
        )
    return ProtocolLaw(
        scenario.agent,
        make_protocol(
            designed.network,
            designed.K,
            designed.E,
            designed.phi,
            designed.mu,
            designed.observer,
            designed.protocol,
        ),
    )


def extras(scenario: Scenario) -> tuple[str, ...]:
    """Return what the law measures beside y."""
    if scenario.control.python is not None:
        from posmas_fmi.cosim.python_law import load_class

        made = load_class(scenario.control.python, scenario.path.parent)
        return tuple(getattr(made, "extras", ()))
    if scenario.cooling is None or scenario.control.law == "protocol":
        return ()
    from posmas_fmi.cooling.control import EXTRAS

    return EXTRAS


def law_network(scenario: Scenario, designed: Design) -> Network:
    """Return the digraph over which the law's messages go."""
    if scenario.cooling is None:
        return designed.network
    from posmas_fmi.scenario.cooling import network_of

    return network_of(scenario.control, designed.network)


def _more(scenario: Scenario, law: Law) -> Callable[[Array], dict[str, Array]]:
    """Return what is recorded besides, as a function of times."""
    if scenario.cooling is None:
        return lambda times: {}
    from posmas_fmi.scenario.cooling import set_points

    return set_points(scenario.cooling, law)


def make_system(scenario: Scenario, designed: Design, instances: Instances) -> System:
    """Put the definition of the co-simulation together."""
    network, law = designed.network, make_law(scenario, designed)
    return System(
        agent=scenario.agent,
        network=network,
        law=law,
        channel=make_channel(scenario.channel, network, scenario.clock.h),
        clock=scenario.clock,
        xhat0=scenario.xhat0,
        s0=scenario.s0,
        seed=scenario.settings.seed,
        wiring=instances.wiring,
        episodes=make_episodes(list(scenario.faults), network, scenario.agent, scenario.clock),
        leader_changes=scenario.jumps,
        crashes=make_crashes(list(scenario.faults), network, scenario.clock),
        sensors=_sensors(scenario.sensors, len(law.extras)),
        every=instances.every,
        **_coupling(scenario),
    )


def _coupling(scenario: Scenario) -> dict[str, Any]:
    """How connected FMUs step, as arguments of `System`."""
    N, coupling = scenario.network.N, scenario.settings.coupling
    if coupling == "iterate":
        return {"iteration": Iteration()}
    if coupling == "gauss-seidel":
        components = (np.array([N + k]) for k in range(len(scenario.components)))
        return {"stages": (np.arange(N), *components)}
    return {}


def _sensors(of_outputs: Sensors | None, extras: int) -> Sensors | None:
    """Add sensors of what is measured beside y: exact ones."""
    if of_outputs is None:
        return None
    exact = ((0, 0), (0, extras))
    return Sensors(np.pad(of_outputs.noise, exact), np.pad(of_outputs.resolution, exact))


def _recorder(
    scenario: Scenario,
    network: Network,
    instances: Instances,
    folder: Path,
    variables: tuple[str, ...],
    beginning: Beginning,
) -> Recorder:
    agent, recorded = scenario.agent, instances.recorded
    steps, every = scenario.clock.steps, scenario.record.every
    before = -(-beginning.origin // every)  # those of another run
    expected = steps // every + 1 + (steps % every > 0) - before
    layout = Layout(
        agents=network.names,
        states=tuple(f"x{k + 1}" for k in range(agent.m)),
        inputs=tuple(f"u{k + 1}" for k in range(agent.p)),
        outputs=tuple(f"y{k + 1}" for k in range(agent.q)),
        of_agents=tuple(recorded.of_agents),
        of_run=(*recorded.of_components, *(("set_point",) if scenario.cooling else ())),
        units={**recorded.units, **({"set_point": "K"} if scenario.cooling else {})},
    )
    attributes = {
        "scenario": scenario.name,
        "period": scenario.clock.h,
        "created_by": f"posmas-fmi {metadata.version('posmas-fmi')}",
    }
    names = (*variables, *layout.of_agents, *layout.of_run)
    path, keep = folder / "results.nc", beginning.keep
    return Recorder(path, layout, network, names, attributes, keep, max(1, expected))


def manifest(
    scenario: Scenario, files: list[Path], choice: engine.Choice, command: str
) -> dict[str, Any]:
    """Return what makes the run repeatable: versions, seed, hashes, the scenario itself."""
    return {
        "command": command,
        "scenario": scenario.text,
        "scenario_sha256": _hash(scenario.text.encode()),
        "seed": scenario.settings.seed,
        "engine": choice.to_dict() | {"threads": scenario.settings.threads},
        "period": scenario.clock.h,
        "until": scenario.clock.time(scenario.clock.steps),
        "fmus": {path.name: _hash(path.read_bytes()) for path in dict.fromkeys(files)},
        "start_values_sha256": _hash(json.dumps(parameters(scenario), default=str).encode()),
        "inputs": {path.name: _hash(path.read_bytes()) for path in scenario.inputs},
        "versions": {name: metadata.version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
    }


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file; NaN is refused."""
    with whole(path) as file:
        file.write(json.dumps(content, indent=2, allow_nan=False) + "\n")
