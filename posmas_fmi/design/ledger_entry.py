"""One line of the ledger of the paper, and how its numbers are written and compared."""

from __future__ import annotations

from typing import Any, Literal

import attrs
import numpy as np

Verdict = Literal["reproduced", "rounded", "contradicted", "infeasible"]


@attrs.frozen
class Entry:
    """One line of the ledger.

    Attributes
    ----------
    place : str
        Example, algorithm or equation.
    item : str
        What is printed.
    printed, computed : str
    verdict : {"reproduced", "rounded", "contradicted", "infeasible"}
    proof : str
        What a reader can check by hand or in exact arithmetic.
    erratum : int or None
        Number in theory.md, section 2.
    """

    place: str
    item: str
    printed: str
    computed: str
    verdict: Verdict
    proof: str
    erratum: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return attrs.asdict(self)


VERDICTS: tuple[Verdict, ...] = ("reproduced", "rounded", "contradicted", "infeasible")


def show(value: Any, digits: int = 4) -> str:
    """Write a number, vector or matrix with that many digits after the point."""
    array = np.asarray(value)
    if array.ndim == 0:
        return f"{complex(array):.{digits}f}" if np.iscomplexobj(array) else f"{array:.{digits}f}"
    return "[" + ", ".join(show(row, digits) for row in array) + "]"


def agrees(printed: Any, computed: Any, digits: int) -> bool:
    """Whether every number is the printed one when rounded (or cut) to the printed digits."""
    unit = 10.0**-digits
    difference = np.abs(np.asarray(printed) - np.asarray(computed))
    return bool(difference.max() <= unit * (1 + 1e-9))
