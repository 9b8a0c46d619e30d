"""Controllers to take away: as an FMU, as C, and with the plants in an SSP file."""

from posmas_fmi.export.c_code import c_files
from posmas_fmi.export.controller_fmu import controller_model, values
from posmas_fmi.export.controllers import Controllers, Links
from posmas_fmi.export.ssp import Component, Connection, Connector, Structure, ssp

__all__ = [
    "Component",
    "Connection",
    "Connector",
    "Controllers",
    "Links",
    "Structure",
    "c_files",
    "controller_model",
    "ssp",
    "values",
]
