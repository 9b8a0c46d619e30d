"""g and sec of the agent as the numpy loop evaluates them: with numpy, or compiled."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.cosim.loading import address
from posmas_fmi.expression import Array


@attrs.frozen(eq=False)
class Functions:
    """g and sec of many agents at once, a column each.

    Attributes
    ----------
    g : callable
        ``g(t, X, out)`` for X and out of shape (m, N), written to out.
    sec : callable
        ``sec(U)`` for U of shape (p, N), giving (p, N).

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> Functions.of(linear_agent([[-1.0]], [[1.0]], [[1.0]])).sec(np.array([[2.0, 3.0]]))
    array([[2., 3.]])
    """

    g: Callable[[float, Array, Array], None]
    sec: Callable[[Array], Array]

    @classmethod
    def of(cls, agent: Agent) -> Functions:
        """Take them as they are defined: expressions by numpy, or functions in Python."""
        return cls(agent.g_columns, lambda U: agent.sec_numpy(U.T).T)

    @classmethod
    def compiled(cls, library: ctypes.CDLL) -> Functions:
        """Take those of the engine.

        Parameters
        ----------
        library : ctypes.CDLL
            See `posmas_fmi.cosim.law.ProtocolLaw.sources`. Arrays are to stand in one piece, row
            after row.
        """
        pointer, size = ctypes.c_void_p, ctypes.c_int64
        g_in_c, sec_in_c = library.agent_columns_g, library.agent_columns_sec
        g_in_c.argtypes, g_in_c.restype = [ctypes.c_double, pointer, pointer, size], None
        sec_in_c.argtypes, sec_in_c.restype = [pointer, pointer, size], None

        def g(t: float, X: Array, out: Array) -> None:
            g_in_c(t, address(X), address(out), X.shape[1])

        def sec(U: Array) -> Array:
            out = np.empty_like(U)
            sec_in_c(address(U), address(out), U.shape[1])
            return out

        return cls(g, sec)
