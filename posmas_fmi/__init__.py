"""Control design with FMUs for process cooling: proved pinning consensus of positive networks.

The public names are those listed here, each imported when it is first used, and the functions
`design` and `certify` of `posmas_fmi.design`.

Examples
--------
>>> from posmas_fmi import load
>>> from posmas_fmi.design import design
>>> scenario = load("paper_example_1_tanh")
>>> made = design(scenario.agent, scenario.network, scenario.design, scenario.clock.h)
>>> made.certificate.certified
'yes'
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from posmas_fmi.agent import Agent, Assumption, linear_agent
    from posmas_fmi.certify.certificate import Certificate, Condition
    from posmas_fmi.design import Design, DesignSettings
    from posmas_fmi.errors import PosmasError
    from posmas_fmi.expression import VectorFunction
    from posmas_fmi.fmu.build import agent_fmu
    from posmas_fmi.fmu.compare import regress
    from posmas_fmi.fmu.file import FmuFile
    from posmas_fmi.network import Network, network_from_arcs
    from posmas_fmi.network_file import read_adjacency
    from posmas_fmi.report import write_report
    from posmas_fmi.scenario import Scenario, load, run

_PLACES = {
    "Agent": "agent",
    "Assumption": "agent",
    "Certificate": "certify.certificate",
    "Condition": "certify.certificate",
    "Design": "design",
    "DesignSettings": "design",
    "FmuFile": "fmu.file",
    "Network": "network",
    "PosmasError": "errors",
    "Scenario": "scenario",
    "VectorFunction": "expression",
    "agent_fmu": "fmu.build",
    "linear_agent": "agent",
    "load": "scenario",
    "network_from_arcs": "network",
    "read_adjacency": "network_file",
    "regress": "fmu.compare",
    "run": "scenario",
    "write_report": "report",
}

__all__ = [
    "Agent",
    "Assumption",
    "Certificate",
    "Condition",
    "Design",
    "DesignSettings",
    "FmuFile",
    "Network",
    "PosmasError",
    "Scenario",
    "VectorFunction",
    "agent_fmu",
    "linear_agent",
    "load",
    "network_from_arcs",
    "read_adjacency",
    "regress",
    "run",
    "write_report",
]


def __getattr__(name: str) -> Any:
    if name in _PLACES:
        return getattr(import_module(f"posmas_fmi.{_PLACES[name]}"), name)
    raise AttributeError(f"module 'posmas_fmi' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
