"""A scenario file and the objects it stands for; running one from file to report."""

from posmas_fmi.scenario.build import Scenario, load
from posmas_fmi.scenario.job import RunResult
from posmas_fmi.scenario.main_job import run

__all__ = ["RunResult", "Scenario", "load", "run"]
