"""The controllers of a scenario to take away: FMUs, C, and an SSP file with the plants."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs

from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.design import Design
from posmas_fmi.errors import InputError
from posmas_fmi.export import Controllers, c_files, controller_model, ssp
from posmas_fmi.fmu.build import archive, write
from posmas_fmi.fmu.compile import PLATFORMS, Platform, host
from posmas_fmi.scenario.build import Scenario
from posmas_fmi.scenario.coverage import coverage
from posmas_fmi.scenario.folder import occupied
from posmas_fmi.scenario.job import make_design_of, make_law, write_json
from posmas_fmi.scenario.plant import fmu_files, make_instances, periods
from posmas_fmi.scenario.structure import structure_of
from posmas_fmi.writing import whole


@attrs.frozen
class Exported:
    """What an export left behind.

    Attributes
    ----------
    folder : Path
        With ``controller-fmi2.fmu``, ``controller-fmi3.fmu``, ``agents.json``, ``design.json``,
        ``README.md``, ``c/`` and, unless there is a reason against it, ``NAME.ssp``.
    design : Design
    files : tuple of Path
        All of them, folders as a whole.
    no_ssp : str
        Why there is no SSP file; empty if there is one.
    delay : dict
        Whether the certificate covers that messages take one period, and why: as a row of
        `posmas_fmi.scenario.coverage.coverage`.
    """

    folder: Path
    design: Design
    files: tuple[Path, ...]
    no_ssp: str
    delay: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return what ``posmas-fmi export --json`` prints."""
        return {
            "folder": str(self.folder),
            "files": [str(path) for path in self.files],
            "no_ssp": self.no_ssp,
            "certified": self.design.certificate.certified,
            "delay": self.delay,
        }


def export(scenario: Scenario, folder: Path, platforms: tuple[str, ...] = ()) -> Exported:
    """Design the controllers of a scenario and write them as FMUs, as C and with the plants as SSP.

    Parameters
    ----------
    scenario : Scenario
    folder : Path
        Made if needed; files of an earlier export are replaced.
    platforms : tuple of str, optional
        For which the controller FMUs are compiled, names of
        `posmas_fmi.fmu.compile.PLATFORMS`; default this machine's.

    Returns
    -------
    Exported

    Raises
    ------
    InputError
        If the controllers are not those of the protocol (6), or agents have different periods.
    PosmasError
        If there is no design, or no compiler.
    """
    _require_protocol(scenario)
    targets = _targets(platforms)
    make_instances(scenario, fmu_files(scenario))  # its mistakes come first
    designed = make_design_of(scenario)
    law = make_law(scenario, designed)
    assert isinstance(law, ProtocolLaw)
    controllers = Controllers(
        law,
        designed.network.adjacency.indices,
        scenario.clock.h,
        scenario.xhat0,
        scenario.s0,
    )
    model, names = controller_model(controllers), designed.network.names
    with occupied(folder):
        files = [folder / f"controller-fmi{fmi}.fmu" for fmi in (2, 3)]
        write(files[0], archive(model, 2, targets))
        write(files[1], archive(model, 3, targets))
        (folder / "c").mkdir(exist_ok=True)
        for name, text in c_files(controllers, names).items():
            with whole(folder / "c" / name) as file:
                file.write(text)
        system, no_ssp = folder / f"{scenario.name}.ssp", ""
        try:
            write(system, ssp(structure_of(scenario, controllers, files[0])))
            files.append(system)
        except InputError as error:
            no_ssp = str(error)
            system.unlink(missing_ok=True)
        write_json(folder / "agents.json", _agents(controllers, names))
        write_json(folder / "design.json", designed.to_dict())
        made = Exported(
            folder,
            designed,
            (*files, *(folder / name for name in ("c", "agents.json", "design.json", "README.md"))),
            no_ssp,
            _delay(scenario, designed),
        )
        with whole(folder / "README.md") as file:
            file.write(_readme(scenario, controllers, made))
    return made


def _require_protocol(scenario: Scenario) -> None:
    """Refuse what is not exported."""
    own = scenario.control.python or scenario.control.law
    if scenario.compare is not None:
        raise InputError("a comparison has several controllers; leave [compare] out", "$.compare")
    if own != "protocol":
        raise InputError(
            f"expected the law 'protocol' (got {own!r}): the other laws are not exported",
            "$.control",
        )
    if scenario.design.method == "integral" or scenario.design.K_q is not None:
        raise InputError("the protocol with integrals is not exported", "$.design.method")
    if scenario.design.protocol == "printed":
        raise InputError(
            "the protocol as printed is unstable, and is not exported; leave it at 'corrected'",
            "$.design.protocol",
        )
    if (periods(scenario)[: scenario.network.N] > 1).any():
        raise InputError(
            "all controllers that are exported have the period of the scenario; export those of "
            "agents with a longer one from a scenario of their own",
            "$.plant.override",
        )


def _targets(names: tuple[str, ...]) -> tuple[Platform, ...]:
    for name in names:
        if name not in PLATFORMS:
            known = ", ".join(PLATFORMS)
            raise InputError(f"expected one of {known} (got {name!r})", "--platform")
    return tuple(PLATFORMS[name] for name in dict.fromkeys(names)) or (host(),)


def _delay(scenario: Scenario, designed: Design) -> dict[str, Any]:
    """Whether the certificate covers the period that every message takes in another master."""
    channel = attrs.evolve(scenario.channel, delay=scenario.clock.h)
    rows = coverage(attrs.evolve(scenario, channel=channel), designed)
    return next(row for row in rows if row["what"] == "delay of messages")


def _agents(controllers: Controllers, names: tuple[str, ...]) -> dict[str, Any]:
    rows = []
    for i, (name, links) in enumerate(zip(names, controllers.links, strict=True)):
        given = {**controllers.parameters(i), **controllers.first(i)}
        rows.append(
            {
                "name": name,
                "hears": [names[sender] for sender in links.senders],
                "hears_leader": links.leader != 0,
                "values": {key: value.tolist() for key, value in given.items()},
            }
        )
    return {"period": controllers.h, "agents": rows}


def _readme(scenario: Scenario, controllers: Controllers, made: Exported) -> str:
    agent = scenario.agent
    system = f"`{scenario.name}.ssp`: plants, controllers and leader, connected (SSP 1.0, FMI 2)."
    if made.no_ssp:
        system = f"There is no SSP file: {made.no_ssp}."
    text = Path(__file__).with_name("export_readme.md").read_text(encoding="utf-8")
    return text.format(
        name=scenario.name,
        period=f"{controllers.h:g}",
        agents=len(controllers.links),
        p=agent.p,
        q=agent.q,
        m=agent.m,
        certified=made.design.certificate.certified,
        system=system,
        covers="covers" if made.delay["covered"] else "does NOT cover",
        why=made.delay["why"],
    )
