"""FMUs that go wrong, compiled from faulty.c, and a network of agents that have them as plants."""

from __future__ import annotations

import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from posmas_fmi.agent import linear_agent
from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.fmu_plant import FmuPlant, Isolation, PlantSpec, PortMap
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import System
from posmas_fmi.fmu.compile import host
from posmas_fmi.network import network_from_arcs
from posmas_fmi.protocol import make_protocol

FAULTS = (
    *("nothing", "segfault", "abort", "exit", "hang", "error", "fatal", "discard", "outside"),
    *("not a number", "stack", "memory", "logs", "output", "closes", "once", "exit reading"),
    *("free crashes", "terminates", "changes", "opens", "fills", "daemon", "slow", "stranger"),
    "tells",
)

DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="faulty" guid="{{faulty}}">
  <CoSimulation modelIdentifier="faulty" canHandleVariableCommunicationStepSize="true"
    canGetAndSetFMUstate="{states}" canSerializeFMUstate="{states}"
    canBeInstantiatedOnlyOncePerProcess="{once}"/>
  <ModelVariables>
    <ScalarVariable name="x" valueReference="0" causality="output" variability="continuous"
      initial="exact"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="u" valueReference="1" causality="input" variability="continuous">
      <Real start="0"/></ScalarVariable>
    <ScalarVariable name="fault" valueReference="2" causality="parameter" variability="fixed">
      <Real start="0"/></ScalarVariable>
    <ScalarVariable name="at" valueReference="3" causality="parameter" variability="fixed">
      <Real start="1"/></ScalarVariable>
    <ScalarVariable name="cost" valueReference="4" causality="parameter" variability="fixed">
      <Real start="0"/></ScalarVariable>
  </ModelVariables>
  <ModelStructure><Outputs><Unknown index="1"/></Outputs>
    <InitialUnknowns><Unknown index="1"/></InitialUnknowns></ModelStructure>
</fmiModelDescription>
"""


def faulty_fmu(folder: Path, *, once: bool = False, states: bool = True) -> Path:
    """Compile the FMU; `once`: a process may hold one instance only."""
    library = folder / f"faulty{host().extension}"
    source = Path(__file__).with_name("faulty.c")
    flags = ["-DONLY_ONCE"] if once else []
    command = ["cc", "-O1", "-shared", "-fPIC", *flags, str(source), "-o", str(library), "-lm"]
    subprocess.run(command, check=True)
    text = DESCRIPTION.format(states=str(states).lower(), once=str(once).lower())
    path = folder / f"faulty{'_once' if once else ''}{'' if states else '_stateless'}.fmu"
    import fmpy

    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        archive.write(library, f"binaries/{fmpy.platform}/faulty{fmpy.sharedLibraryExtension}")
    return path


def values(fault: str = "nothing", at: float = 0.5, **more: float) -> dict[str, float]:
    return {"fault": float(FAULTS.index(fault)), "at": at, **more}


def faulty_system(n: int = 3, until: float = 1.0, **options: Any) -> System:
    """A path of n agents, the first pinned."""
    agent = linear_agent([[-1.0]], [[1.0]], [[1.0]])
    network = network_from_arcs(n, [(k, k + 1) for k in range(1, n)], [1])
    return System(
        agent=agent,
        network=network,
        law=ProtocolLaw(agent, make_protocol(network, [[-0.5]], [[0.5]], 1.0)),
        channel=Channel.uniform(network.adjacency.nnz + 1, 0.05, 0.0, 0.0, 0.0),
        clock=Clock.of(until, 0.05),
        xhat0=np.zeros((n, 1)),
        s0=np.array([1.0]),
        **options,
    )


def faulty_plant(
    fmu: Path, faults: dict[int, dict[str, float]], isolation: Isolation, n: int = 3
) -> FmuPlant:
    """Make n agents; some of them have a fault."""
    specs = [PlantSpec(fmu, {"x": 0.1, **faults.get(k, values())}) for k in range(n)]
    inputs, outputs = PortMap.plain(["u"]), PortMap.plain(["x"])
    names = [str(k + 1) for k in range(n)]
    return FmuPlant.of_agents(names, specs, inputs, outputs, outputs, 1e9, isolation)
