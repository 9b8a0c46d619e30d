"""A design: gains, what is proved about them, and what no control would give."""

from __future__ import annotations

from typing import Any, Literal

import attrs
import numpy as np

from posmas_fmi.certify.certificate import Certificate, json_number
from posmas_fmi.expression import Array
from posmas_fmi.network import Network


@attrs.frozen
class Baseline:
    """What K = 0 gives: a plant that contracts by itself needs no consensus to follow a leader.

    Attributes
    ----------
    contracts : bool
    rate : float or None
        Best rate that certificate C gives without control [1/s]; negative where it diverges.
    """

    contracts: bool
    rate: float | None


@attrs.frozen(eq=False)
class Design:
    """Gains with their certificate.

    Attributes
    ----------
    method : str
    observer : {"local", "distributed"}
    phi, mu : float
        Couplings of controller and distributed observer.
    K : (p, m) array
        Feedback gain, ``K ≤ 0``.
    E : (m, q) array
        Observer gain.
    network : Network
        With the pinning that the design is for.
    certificate : Certificate
    baseline : Baseline
    protocol : {"corrected", "printed"}
        Signs that the running controller uses (errata 1 and 2).
    form : {"corrected", "printed", "joint"}
        Form of the paper's algorithms, where one was used.
    notes : tuple of str
        What a reader should know about how the gains came about.
    K_q : (p, k) array or None
        Gain of the integrals, of the integral protocol.
    integrates : tuple of str
        Outputs that it integrates.
    """

    method: str
    observer: Literal["local", "distributed"]
    phi: float
    mu: float
    K: Array
    E: Array
    network: Network
    certificate: Certificate
    baseline: Baseline
    protocol: Literal["corrected", "printed"] = "corrected"
    form: Literal["corrected", "printed", "joint"] = "corrected"
    notes: tuple[str, ...] = ()
    K_q: Array | None = None
    integrates: tuple[str, ...] = ()

    @property
    def pinned(self) -> tuple[str, ...]:
        """Names of the pinned agents."""
        return tuple(self.network.names[i] for i in self.network.pinned)

    def to_dict(self) -> dict[str, Any]:
        """Return what ``posmas-fmi design --json`` prints; every value is JSON-safe."""
        return {
            "method": self.method,
            "observer": self.observer,
            "phi": self.phi,
            "mu": self.mu,
            "protocol": self.protocol,
            "form": self.form,
            "K": _rows(self.K),
            "E": _rows(self.E),
            "K_q": None if self.K_q is None else _rows(self.K_q),
            "integrates": list(self.integrates),
            "pinned": list(self.pinned),
            **self.certificate.to_dict(),
            "baseline": {
                "contracts": self.baseline.contracts,
                "rate": json_number(self.baseline.rate),
            },
            "notes": list(self.notes),
        }


def _rows(M: Array) -> list[list[float]]:
    return [[float(v) + 0.0 for v in row] for row in np.atleast_2d(M)]
