"""Other co-simulation masters on the same FMUs: plants alone, and the closed loop on equal terms.

On equal terms a peer runs what the engine runs: the plants, a controller FMU per agent made from
the engine's own C source (`controller_fmu.c`), a leader FMU, and the arcs of the same digraph as
connections. These masters step all FMUs from t to t + h and pass outputs on at t + h (Jacobi). So a
controller acts on y and messages of t, as ours does, but its u reaches the plant at t + h.
"""

from __future__ import annotations

import ctypes
import hashlib
import io
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

from posmas_fmi.agent import Agent
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import System
from posmas_fmi.fmu import build
from posmas_fmi.fmu.compile import host, shared_library

SOURCE = Path(__file__).parent / "controller_fmu.c"


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
    """Each element of an array by its name."""
    array = np.asarray(array, dtype=float)
    return {
        f"{name}[{','.join(str(i + 1) for i in index)}]": float(value)
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
    """The plants with the controllers, the leader and the digraph of a system.

    The channel must be ideal and the observer local.
    """
    law, network, agent = system.law, system.network, system.agent
    assert isinstance(law, ProtocolLaw)
    assert system.channel.ideal
    weights = law.weights
    assert not weights.heard_innovation.nnz
    plants = plants_alone(system, x0, cache)
    heard = max(1, int(np.diff(network.adjacency.indptr).max(initial=0)))
    path = controller_fmu(law, system.clock.h, heard, cache)
    fmus: dict[str, Path] = dict(plants.fmus)
    values: dict[str, Mapping[str, float]] = dict(plants.values)
    wires: list[tuple[str, str, str, str]] = []

    def connect(source: str, output: str, sink: str, target: str, count: int) -> None:
        wires.extend(
            (source, f"{output}[{j + 1}]", sink, target.format(j + 1)) for j in range(count)
        )

    fmus["s"], values["s"] = path, elements("xhat", system.s0)
    by_arc = weights.heard.tocsr()
    for i in range(network.N):
        plant, controller = f"p{i:05}", f"c{i:05}"
        arcs = by_arc.indices[by_arc.indptr[i] : by_arc.indptr[i + 1]]
        strength = by_arc.data[by_arc.indptr[i] : by_arc.indptr[i + 1]]
        fmus[controller] = path
        values[controller] = {
            "own": float(weights.own[i]),
            "leader": float(weights.leader[i]),
            "innovation": float(weights.own_innovation[i]),
            **elements("weight", strength),
            **elements("xhat", system.xhat0[i]),
        }
        connect(plant, "y", controller, "y[{}]", agent.q)
        connect(controller, "u", plant, "u[{}]", agent.p)
        for place, sender in enumerate(system.senders[arcs]):
            connect(f"c{sender:05}", "xhat", controller, f"heard[{place + 1},{{}}]", agent.m)
        if i in network.pinned:
            connect("s", "xhat", controller, "s[{}]", agent.m)
    return Loop(system.clock.h, fmus, values, tuple(wires))


def controller_fmu(law: ProtocolLaw, h: float, heard: int, cache: Path | None = None) -> Path:
    """The FMU of `controller_fmu.c` for one law, period [s] and number of neighbours."""
    sources = law.sources()
    own = ("controller.c", "controller.h", "step.h", "lanes.h", "agent_functions.h", "export.h")
    files = {name: sources.files[name] for name in own}
    files["fmi2.h"] = (Path(build.__file__).parent / "csrc" / "fmi2.h").read_text(encoding="utf-8")
    files["controller_fmu.c"] = SOURCE.read_text(encoding="utf-8")
    constants = ", ".join(value.hex() for value in law.constants(h).tolist())
    token = hashlib.sha256(f"{files}{constants}{heard}".encode()).hexdigest()[:32]
    files["controller_data.h"] = (
        f'#define TOKEN "{token}"\nenum {{ HEARD = {heard} }};\n'
        f"static const Controller CONTROLLER = {{{constants}}};\n"
    )
    folder = (cache or build.cache_folder()) / "controllers"
    path = folder / f"controller-{token}.fmu"
    if path.is_file():
        return path
    target = host()
    binary = shared_library(files, ["controller.c", "controller_fmu.c"], "controller", target)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("modelDescription.xml", _description(law.agent, heard, token))
        archive.writestr(f"binaries/{target.fmi2}/controller{target.extension}", binary)
    build.write(path, content.getvalue())
    return path


def _description(agent: Agent, heard: int, token: str) -> str:
    m, p, q = agent.m, agent.p, agent.q
    roles = [
        ("input", "continuous", ' start="0"', elements("y", np.zeros(q))),
        ("input", "continuous", ' start="0"', elements("heard", np.zeros((heard, m)))),
        ("input", "continuous", ' start="0"', elements("s", np.zeros(m))),
        ("parameter", "tunable", ' start="0"', ["own", *elements("weight", np.zeros(heard))]),
        ("parameter", "tunable", ' start="0"', ["leader", "innovation"]),
        ("output", "continuous", ' start="0"', elements("u", np.zeros(p))),
        ("output", "continuous", ' start="0"', elements("xhat", np.zeros(m))),
    ]
    rows, outputs, number = [], [], 0
    for causality, variability, start, names in roles:
        initial = ' initial="exact"' if causality == "output" else ""
        for name in names:
            rows.append(
                f'<ScalarVariable name="{name}" valueReference="{number}" causality="{causality}" '
                f'variability="{variability}"{initial}><Real{start}/></ScalarVariable>'
            )
            number += 1
            if causality == "output":
                outputs.append(f'<Unknown index="{number}"/>')
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="2.0" modelName="controller" guid="{token}">'
        '<CoSimulation modelIdentifier="controller" '
        'canHandleVariableCommunicationStepSize="false"/>'
        f"<ModelVariables>{''.join(rows)}</ModelVariables>"
        f"<ModelStructure><Outputs>{''.join(outputs)}</Outputs>"
        f"<InitialUnknowns>{''.join(outputs)}</InitialUnknowns></ModelStructure>"
        "</fmiModelDescription>"
    )


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
