"""The controllers of a scenario to take away: C, FMUs, and an SSP file with the plants."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from posmas_fmi.cosim.fmus import PortMap
from posmas_fmi.cosim.law import CompiledLaw, ProtocolLaw
from posmas_fmi.design import Design
from posmas_fmi.errors import BuildError, InputError
from posmas_fmi.export import Controllers, c_files, controller_model, ssp, values
from posmas_fmi.fmu.build import archive, platforms_for, write
from posmas_fmi.fmu.compile import Platform
from posmas_fmi.fmu.sources import FmiVersion
from posmas_fmi.scenario.build import Scenario
from posmas_fmi.scenario.compare import controllers
from posmas_fmi.scenario.coverage import coverage
from posmas_fmi.scenario.folder import occupied
from posmas_fmi.scenario.job import (
    extras,
    facts_of,
    law_network,
    make_design_of,
    make_law,
    write_json,
)
from posmas_fmi.scenario.plant import Instances, fmu_files, make_instances, periods
from posmas_fmi.scenario.structure import structure_of
from posmas_fmi.writing import whole

_FMUS: dict[FmiVersion, str] = {2: "controller-fmi2.fmu", 3: "controller-fmi3.fmu"}


@attrs.frozen
class Exported:
    """What an export left behind.

    Attributes
    ----------
    folder : Path
    design : Design
    files : tuple of Path
        What was written: ``c/``, ``agents.json``, ``design.json`` and ``README.md``; the FMUs and
        ``NAME.ssp`` unless there is a reason against them.
    no_fmu, no_ssp : str
        That reason; empty if they are there.
    certified : {"yes", "conditional", "no"}
        Of the law, as in design.json.
    delay : dict
        Whether the certificate covers messages that take one period, and why: as a row of
        `posmas_fmi.scenario.coverage.coverage`.
    """

    folder: Path
    design: Design
    files: tuple[Path, ...]
    no_fmu: str
    no_ssp: str
    certified: str
    delay: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return what ``posmas-fmi export --json`` prints."""
        return {
            "folder": str(self.folder),
            "files": [str(path) for path in self.files],
            "no_fmu": self.no_fmu,
            "no_ssp": self.no_ssp,
            "certified": self.certified,
            "delay": self.delay,
        }


def export(
    scenario: Scenario,
    folder: Path,
    platforms: tuple[str, ...] = (),
    controller: str | None = None,
) -> Exported:
    """Design the controllers of a scenario and write them as C, as FMUs and with the plants as SSP.

    Parameters
    ----------
    scenario : Scenario
    folder : Path
        Made if needed; files of an earlier export are replaced.
    platforms : tuple of str, optional
        For which the controller FMUs are compiled, names of
        `posmas_fmi.fmu.compile.PLATFORMS`; default this machine's.
    controller : str, optional
        Which one of a comparison.

    Returns
    -------
    Exported

    Raises
    ------
    InputError
        If the controllers cannot be had in C, or agents have different periods.
    PosmasError
        If there is no design, or no compiler for a platform that was asked for.
    """
    scenario = _one(scenario, controller)
    _refuse(scenario)
    targets = {fmi: _targets(platforms, fmi) for fmi in _FMUS}
    instances = make_instances(scenario, fmu_files(scenario), extras(scenario))
    designed = make_design_of(scenario)
    law = make_law(scenario, designed)
    if not isinstance(law, CompiledLaw):
        own = scenario.control.law
        raise InputError(f"the law {own!r} is not there in C, and is not exported", "$.control.law")
    if (law.weights.leader < 0).any():
        raise InputError(
            "with the signs that the paper prints the network is unstable: not exported",
            "$.design.protocol" if isinstance(law, ProtocolLaw) else "$.control",
        )
    network, names = law_network(scenario, designed), designed.network.names
    senders = network.adjacency.indices
    program = Controllers(law, senders, scenario.clock.h, scenario.xhat0, scenario.s0)
    facts = facts_of(scenario, designed)
    fmus, no_fmu = _built(program, targets, bool(platforms))
    with occupied(folder):
        (folder / "c").mkdir(exist_ok=True)
        for name, text in c_files(program, names).items():
            with whole(folder / "c" / name) as file:
                file.write(text)
        more, no_ssp = _write_fmus(scenario, program, folder, fmus, no_fmu)
        agents = _agents(scenario, program, instances, names, bool(more))
        write_json(folder / "agents.json", agents)
        write_json(folder / "design.json", facts)
        last = tuple(folder / name for name in ("agents.json", "design.json", "README.md"))
        files = (folder / "c", *more, *last)
        delay = _delay(scenario, designed, facts["certified"])
        made = Exported(folder, designed, files, no_fmu, no_ssp, facts["certified"], delay)
        with whole(folder / "README.md") as file:
            file.write(_readme(scenario, program, made))
    return made


def _one(scenario: Scenario, controller: str | None) -> Scenario:
    """Take one controller of a comparison."""
    if scenario.compare is None:
        if controller is not None:
            raise InputError("the scenario compares no controllers: leave it out", "--controller")
        return scenario
    there = controllers(scenario)
    if controller not in there:
        known = ", ".join(there)
        got = "" if controller is None else f" (got {controller!r})"
        raise InputError(f"choose one of {known}{got}", "--controller")
    return attrs.evolve(scenario, compare=None, control=there[controller])


def _refuse(scenario: Scenario) -> None:
    """Refuse at once what is not exported."""
    if scenario.control.python is not None:
        raise InputError("controllers of your own are in Python: not exported", "$.control.python")
    integral = scenario.design.method == "integral" or scenario.design.K_q is not None
    if integral and scenario.cooling is None:
        raise InputError("the protocol with integrals is not exported", "$.design.method")
    if (periods(scenario)[: scenario.network.N] > 1).any():
        raise InputError(
            "all controllers that are exported have the period of the scenario; export those of "
            "agents with a longer one from a scenario of their own",
            "$.plant.override",
        )


def _targets(names: tuple[str, ...], fmi: FmiVersion) -> tuple[Platform, ...]:
    try:
        return platforms_for(names or None, fmi)
    except BuildError as error:
        raise InputError(error.message, "--platform") from None


def _built(
    program: Controllers, targets: Mapping[FmiVersion, tuple[Platform, ...]], must: bool
) -> tuple[dict[str, bytes], str]:
    """Return the FMUs by name, or why there are none; without a compiler, an error if they must."""
    try:
        model = controller_model(program)
        return {name: archive(model, fmi, targets[fmi]) for fmi, name in _FMUS.items()}, ""
    except InputError as error:
        return {}, error.message
    except BuildError as error:
        if must:
            raise
        return {}, error.message


def _write_fmus(
    scenario: Scenario, program: Controllers, folder: Path, fmus: Mapping[str, bytes], why: str
) -> tuple[list[Path], str]:
    """Write FMUs and SSP file in place of those of another time; why there is no SSP file."""
    system = folder / f"{scenario.name}.ssp"
    for path in (*(folder / name for name in _FMUS.values()), system):
        path.unlink(missing_ok=True)
    if not fmus:
        return [], why
    paths = [folder / name for name in fmus]
    for path, data in zip(paths, fmus.values(), strict=True):
        write(path, data)
    try:
        write(system, ssp(structure_of(scenario, program, paths[0])))
    except InputError as error:
        return paths, str(error)
    return [*paths, system], ""


def _agents(
    scenario: Scenario,
    made: Controllers,
    instances: Instances,
    names: tuple[str, ...],
    with_values: bool,
) -> dict[str, Any]:
    """Return agents.json; values are those of the FMUs."""
    agent, rows = scenario.agent, []
    for i, (name, links) in enumerate(zip(names, made.links, strict=True)):
        spec = instances.specs[i]
        ports = {**_ports("u", agent.p, spec.inputs), **_ports("y", agent.q, spec.readings)}
        row: dict[str, Any] = {
            "name": name,
            "hears": [names[sender] for sender in links.senders],
            "hears_leader": links.leader != 0,
            "ports": ports,
        }
        if with_values:
            row["values"] = {key: value.tolist() for key, value in values(made, i).items()}
        rows.append(row)
    measured = {name: scenario.plant.measured[name] for name in extras(scenario)}
    return {"period": made.h, "measured": measured, "agents": rows}


def _ports(letter: str, count: int, ports: PortMap) -> dict[str, dict[str, Any]]:
    return {
        f"{letter}{k + 1}": {
            "variable": ports.variables[k],
            "scale": ports.scale[k],
            "offset": ports.offset[k],
        }
        for k in range(count)
    }


def _delay(scenario: Scenario, designed: Design, certified: str) -> dict[str, Any]:
    """Whether the certificate covers that messages take one period."""
    if certified == "no":
        return {"what": "delay of messages", "covered": False, "why": "nothing is proved"}
    channel = attrs.evolve(scenario.channel, delay=scenario.clock.h)
    rows = coverage(attrs.evolve(scenario, channel=channel), designed)
    return next(row for row in rows if row["what"] == "delay of messages")


def _readme(scenario: Scenario, of: Controllers, made: Exported) -> str:
    def template(name: str) -> str:
        return Path(__file__).with_name(name).read_text(encoding="utf-8")

    agent = scenario.agent
    fmus = f"There are no FMUs: {made.no_fmu}.\n"
    if not made.no_fmu:
        system = f"`{scenario.name}.ssp`: plants, controllers and leader, connected (FMI 2)."
        if made.no_ssp:
            system = f"There is no SSP file: {made.no_ssp}."
        fmus = template("export_fmus.md").format(system=system)
    return template("export_readme.md").format(
        name=scenario.name,
        period=f"{of.h:g}",
        agents=len(of.links),
        p=agent.p,
        q=agent.q,
        m=agent.m,
        certified=made.certified,
        measured=", ".join(["y", *extras(scenario)]),
        covers="covers" if made.delay["covered"] else "does NOT cover",
        why=made.delay["why"],
        fmus=fmus,
    )
