"""The step of the protocol's controllers in C, for the loop that is not."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import numpy as np

from posmas_fmi.cosim.loading import address
from posmas_fmi.expression import Array

_pointer, _int = ctypes.c_void_p, ctypes.c_int64
# from t, disagreement (w, N), memory (m, N) and that of the leader (m,) to the memory and the
# leader's at t + h, u (p, N) and sec(u) (p, N): a column for each agent
Step = Callable[[float, Array, Array, Array], tuple[Array, Array, Array, Array]]


def compiled_step(library: ctypes.CDLL, constants: Array, p: int) -> Step:
    """Return what agents do at a communication point, and the observers over the step after it.

    Parameters
    ----------
    library : ctypes.CDLL
        See `posmas_fmi.cosim.law.ProtocolLaw.sources`.
    constants : array
        Of the step: see `posmas_fmi.cosim.law.ProtocolLaw.constants`.
    p : int
        Inputs of an agent.
    """
    in_c = library.controller_columns
    in_c.argtypes = [_pointer, ctypes.c_double, *(_pointer,) * 5, _int, *(_pointer,) * 2]
    in_c.restype = None

    def step(
        t: float, disagreement: Array, memory: Array, leader: Array
    ) -> tuple[Array, Array, Array, Array]:
        m, N = memory.shape
        after, ahead = np.empty((m, N)), np.empty(m)
        u, applied = np.empty((p, N)), np.empty((p, N))
        given = (address(one) for one in (disagreement, memory, after, u, applied))
        in_c(address(constants), t, *given, N, address(leader), address(ahead))
        return after, ahead, u, applied

    return step
