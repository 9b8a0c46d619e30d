"""A scenario file and the objects it stands for; running one from file to report."""

from posmas_fmi.scenario.build import Scenario, load
from posmas_fmi.scenario.job import RunResult, run

__all__ = ["RunResult", "Scenario", "load", "run"]
