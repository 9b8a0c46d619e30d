"""Other co-simulation masters on the same FMUs: plants alone, and the closed loop on equal terms.

On equal terms a peer runs what the engine runs: the plants, for each agent the controller that
`posmas-fmi export` writes (the engine's own C source), a leader FMU, and the arcs of the same
digraph as connections. These masters step all FMUs from t to t + h and pass outputs on at t + h
(Jacobi). So what agents tell each other takes one period, and so does nothing else.
"""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import System
from posmas_fmi.export import Controllers, controller_model
from posmas_fmi.export import values as values_of
from posmas_fmi.fmu import build


class Skip(Exception):  # noqa: N818
    """Why a peer is left out."""


# ---- what they run -------------------------------------------------------------------------------


@attrs.frozen(eq=False)
class Loop:
    """FMUs of FMI 2 by instance, their start values, and connections.

    Attributes
    ----------
    h : float
        Communication step [s].
    fmus : mapping of str to Path
    values : mapping of str to (mapping of str to float)
    wires : tuple of (str, str, str, str)
        Instance and output, instance and input.
    """

    h: float
    fmus: Mapping[str, Path]
    values: Mapping[str, Mapping[str, float]]
    wires: tuple[tuple[str, str, str, str], ...] = ()

    def of(self, kind: str) -> list[str]:
        """Names of the plants ("p"), the controllers ("c") or the leader ("s")."""
        return [name for name in self.fmus if name[0] == kind]


def elements(name: str, array: Any) -> dict[str, float]:
    """Each element of an array by its name; a number by its own."""
    array = np.asarray(array, dtype=float)
    return {
        f"{name}[{','.join(str(i + 1) for i in index)}]" if index else name: float(value)
        for index, value in np.ndenumerate(array)
    }


def plants_alone(system: System, x0: np.ndarray, cache: Path | None = None) -> Loop:
    """The plants without a controller or a connection."""
    agent = system.agent
    path = build.agent_fmu(agent.g, agent.sec, agent.m, agent.p, agent.q, 2, cache=cache)
    common = {name: getattr(agent, name) for name in "AHBC"}
    given = {k: v for name, array in common.items() for k, v in elements(name, array).items()}
    names = [f"p{i:05}" for i in range(system.network.N)]
    values = {name: {**given, **elements("x", x)} for name, x in zip(names, x0, strict=True)}
    return Loop(system.clock.h, dict.fromkeys(names, path), values)


def closed_loop(system: System, x0: np.ndarray, cache: Path | None = None) -> Loop:
    """The plants with the controllers, the leader and the digraph of a system, as exported.

    The channel must be ideal and the observer local.
    """
    law, agent = system.law, system.agent
    assert isinstance(law, ProtocolLaw)
    assert system.channel.ideal
    assert not law.weights.heard_innovation.nnz
    made = Controllers(law, system.senders, system.clock.h, system.xhat0, system.s0)
    plants = plants_alone(system, x0, cache)
    path = build.fmu(controller_model(made), 2, cache=cache)
    fmus: dict[str, Path] = dict(plants.fmus)
    values: dict[str, Mapping[str, float]] = dict(plants.values)
    wires: list[tuple[str, str, str, str]] = []

    def connect(source: str, output: str, sink: str, target: str, count: int) -> None:
        wires.extend(
            (source, f"{output}[{j + 1}]", sink, target.format(j + 1)) for j in range(count)
        )

    def flat(given: Mapping[str, Any]) -> dict[str, float]:
        return {k: v for name, array in given.items() for k, v in elements(name, array).items()}

    fmus["s"] = build.agent_fmu(agent.g, agent.sec, agent.m, agent.p, agent.m, 2, cache=cache)
    idle = {"A": agent.A, "H": agent.H, "B": 0 * agent.B, "C": np.eye(agent.m), "x": system.s0}
    values["s"] = flat(idle)
    for i, links in enumerate(made.links):
        plant, controller = f"p{i:05}", f"c{i:05}"
        fmus[controller] = path
        values[controller] = flat(values_of(made, i))
        connect(plant, "y", controller, "y[{}]", agent.q)
        connect(controller, "u", plant, "u[{}]", agent.p)
        for place, sender in enumerate(links.senders):
            connect(f"c{sender:05}", "sent", controller, f"heard[{place + 1},{{}}]", agent.m)
        if links.leader:
            connect("s", "y", controller, "s[{}]", agent.m)
    return Loop(system.clock.h, fmus, values, tuple(wires))


# ---- the peers -----------------------------------------------------------------------------------


@attrs.frozen(eq=False)
class Peer:
    """A master that is ready to run: steps, and a value where it was asked to observe."""

    advance: Callable[[int], None]
    read: Callable[[str, str], float]


@contextmanager
def temporary_files() -> Iterator[None]:
    """Let a peer leave what it unpacks in a folder that goes away with it."""
    before = os.environ.get("TMPDIR")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["TMPDIR"] = folder
        try:
            yield
        finally:
            if before is None:
                del os.environ["TMPDIR"]
            else:
                os.environ["TMPDIR"] = before


@contextmanager
def libcosim(loop: Loop, observe: bool = False) -> Iterator[Peer]:
    """libcosim's fixed-step algorithm; the folders that it unpacks to and leaves are removed."""
    with temporary_files(), _libcosim(loop, observe) as peer:
        yield peer


@contextmanager
def _libcosim(loop: Loop, observe: bool) -> Iterator[Peer]:
    try:
        from libcosimpy.CosimExecution import CosimExecution
        from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
        from libcosimpy.CosimObserver import CosimObserver
        from libcosimpy.CosimSlave import CosimLocalSlave
    except (ImportError, OSError) as error:
        raise Skip(str(error)) from error
    import fmpy

    log_output_level(CosimLogLevel.FATAL)
    references = {
        path: {
            v.name: v.valueReference for v in fmpy.read_model_description(str(path)).modelVariables
        }
        for path in set(loop.fmus.values())
    }
    execution = CosimExecution.from_step_size(round(loop.h * 1e9))
    index: dict[str, int] = {}
    for name, path in loop.fmus.items():
        index[name] = execution.add_local_slave(CosimLocalSlave(str(path), name))
        if index[name] < 0:
            raise Skip(f"it refuses instance {len(index)} of {path.name}")

    def reference(name: str, variable: str) -> int:
        return references[loop.fmus[name]][variable]

    for name, values in loop.values.items():
        for variable, value in values.items():
            execution.real_initial_value(index[name], reference(name, variable), value)
    for source, output, sink, target in loop.wires:
        execution.connect_real_variables(
            index[source], reference(source, output), index[sink], reference(sink, target)
        )
    observer = CosimObserver.create_last_value()
    if observe:
        execution.add_observer(observer)

    def advance(steps: int) -> None:
        if not execution.step(steps):
            raise Skip("its step failed")

    def read(name: str, variable: str) -> float:
        return observer.last_real_values(index[name], [reference(name, variable)])[0]

    yield Peer(advance, read)


@contextmanager
def ecos(loop: Loop, observe: bool = False) -> Iterator[Peer]:
    """Ecos with its default fixed-step algorithm."""
    try:
        _load_tbb()
        from ecospy import EcosSimulation, EcosSimulationStructure
    except (ImportError, OSError) as error:
        raise Skip(str(error)) from error
    structure = EcosSimulationStructure()
    for name, path in loop.fmus.items():
        structure.add_model(name, str(path))
    for source, output, sink, target in loop.wires:
        structure.make_real_connection(f"{source}::{output}", f"{sink}::{target}")
    start = {
        f"{name}::{variable}": value
        for name, values in loop.values.items()
        for variable, value in values.items()
    }
    structure.add_parameter_set("start", start)
    with EcosSimulation(loop.h, structure=structure) as simulation:
        simulation.init(parameter_set="start")
        yield Peer(
            simulation.step, lambda name, variable: simulation.get_real(f"{name}::{variable}")
        )


def _load_tbb() -> None:
    """Ecos needs oneTBB, which pip puts where the system does not look."""
    library = Path(sys.prefix, "lib", "libtbb.so.12")
    if library.is_file():
        ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)


def fmpy_ssp(loop: Loop, steps: int) -> Any:
    """Run `fmpy.ssp.simulate_ssp`, which has no stepwise interface; returns its rows.

    At its first step every input is 0; what is connected is passed on from the second on.
    """
    from fmpy.ssp.simulation import simulate_ssp
    from fmpy.ssp.ssd import Parameter, ParameterSet

    start = ParameterSet()
    start.parameters = [
        Parameter(name=f"{name}.{variable}", type="Real", value=value)
        for name, values in loop.values.items()
        for variable, value in values.items()
    ]
    with tempfile.TemporaryDirectory() as folder:
        archive = Path(folder, "loop.ssp")
        _write_ssp(loop, archive)
        return simulate_ssp(
            str(archive), stop_time=(steps - 0.5) * loop.h, step_size=loop.h, parameter_set=start
        )


def _write_ssp(loop: Loop, archive: Path) -> None:
    connected = {(sink, target): (source, output) for source, output, sink, target in loop.wires}
    connector = '<Connector name="{}" kind="{}"><ssc:Real/></Connector>'
    components: list[str] = []
    connections: list[str] = []
    files: dict[Path, str] = {}
    for name, path in loop.fmus.items():
        files.setdefault(path, f"resources/{len(files)}.fmu")
        ports = []
        for variable, causality in _causalities(path).items():
            if causality == "output":
                ports.append(connector.format(variable, "output"))
            elif causality == "input" and ((name, variable) in connected or not loop.wires):
                # an input without a connection makes it fail with UnboundLocalError: "idle" is 0
                element, output = connected.get((name, variable), ("", "idle"))
                start = f'startElement="{element}" ' if element else ""
                ports.append(connector.format(variable, "input"))
                connections.append(
                    f'<Connection {start}startConnector="{output}" endElement="{name}" '
                    f'endConnector="{variable}"/>'
                )
        components.append(
            f'<Component name="{name}" type="application/x-fmu-sharedlibrary" '
            f'source="{files[path]}"><Connectors>{"".join(ports)}</Connectors></Component>'
        )
    outer = "" if loop.wires else f"<Connectors>{connector.format('idle', 'input')}</Connectors>"
    inner = f"<Connections>{''.join(connections)}</Connections>"
    space = "http://ssp-standard.org/SSP1/SystemStructure"
    text = (
        '<?xml version="1.0" encoding="UTF-8"?><SystemStructureDescription version="1.0" name="n" '
        f'xmlns="{space}Description" xmlns:ssc="{space}Common"><System name="loop">{outer}'
        f"<Elements>{''.join(components)}</Elements>{inner}</System></SystemStructureDescription>"
    )
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("SystemStructure.ssd", text)
        for path, place in files.items():
            file.write(path, place)


def _causalities(path: Path) -> dict[str, str]:
    """Causality of each variable of an FMU."""
    import fmpy

    variables = fmpy.read_model_description(str(path)).modelVariables
    return {v.name: v.causality for v in variables}
