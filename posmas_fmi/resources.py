"""Where the files that ship with the package lie: in a checkout and in an installed wheel."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from posmas_fmi.errors import InputError

Kind = Literal["models", "plant_fmus"]

_PACKAGE = Path(__file__).resolve().parent


def shipped(kind: Kind) -> Path:
    """Return the folder of the shipped scenarios (``models``) or plants (``plant_fmus``).

    An installed wheel has them inside the package, a checkout at its top level.

    Raises
    ------
    InputError
        If neither is there.

    Examples
    --------
    >>> shipped("plant_fmus").name
    'plant_fmus'
    """
    for folder in (_PACKAGE / "_data" / kind, _PACKAGE.parent / kind):
        if folder.is_dir():
            return folder
    raise InputError(f"the shipped folder '{kind}' is missing; reinstall the package")


def prebuilt() -> Path:
    """Return the folder of the FMUs that were built at install time; it need not exist."""
    return _PACKAGE / "_built"
