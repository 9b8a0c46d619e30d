"""The controllers of a network as they are shipped: one program, and the data of each agent."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cosim.law import CompiledLaw, Weights
from posmas_fmi.expression import Array

_OF_THE_ENGINE = ("controller.c", "controller.h", "step.h", "lanes.h", "agent_functions.h")


@attrs.frozen(eq=False)
class Links:
    """Whom an agent hears, and with which weights its disagreement with them is weighted.

    Attributes
    ----------
    senders : tuple of int
        The agents that it hears, counted from 0.
    own, leader : float
        Weights of what it sends itself, and of what the leader does; 0: does not hear it.
    weight : (senders,) array
        Of what each sender sends.
    own_innovation : float
    innovation_weight : (senders,) array
        The same for the innovations, of the distributed observer (22).
    """

    senders: tuple[int, ...]
    own: float
    leader: float
    weight: Array
    own_innovation: float
    innovation_weight: Array


@attrs.frozen(eq=False, slots=False)
class Controllers:
    """The controllers of all agents.

    Parameters
    ----------
    law : CompiledLaw
    senders : (arcs,) array of int
        Who sends over each arc, in the order of the rows of the adjacency.
    h : float
        Period [s].
    xhat0 : (N, m) array
        First estimates.
    s0 : (m,) array
        First state of the leader.

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> from posmas_fmi.cosim.law import ProtocolLaw
    >>> from posmas_fmi.network import network_from_arcs
    >>> from posmas_fmi.protocol import make_protocol
    >>> pair = network_from_arcs(2, [(1, 2)], pinned=[1])
    >>> protocol = make_protocol(pair, K=[[-1.0]], E=[[0.5]], phi=2.0)
    >>> law = ProtocolLaw(linear_agent([[-1.0]], [[1.0]], [[1.0]]), protocol)
    >>> controllers = Controllers(law, pair.adjacency.indices, 0.1, np.zeros((2, 1)), np.ones(1))
    >>> [(one.senders, one.own, one.leader) for one in controllers.links]
    [((), 2.0, 2.0), ((0,), 2.0, 0.0)]
    """

    law: CompiledLaw
    senders: np.ndarray[tuple[int], np.dtype[np.int64]]
    h: float
    xhat0: Array
    s0: Array

    @cached_property
    def links(self) -> tuple[Links, ...]:
        """Of each agent."""
        weights: Weights = self.law.weights
        heard, innovation = weights.heard.tocsr(), weights.heard_innovation.tocsr()
        found = []
        for i in range(len(weights.own)):
            arcs = heard.indices[heard.indptr[i] : heard.indptr[i + 1]]
            found.append(
                Links(
                    tuple(self.senders[arcs].tolist()),
                    float(weights.own[i]),
                    float(weights.leader[i]),
                    heard.data[heard.indptr[i] : heard.indptr[i + 1]],
                    float(weights.own_innovation[i]),
                    innovation[[i]].toarray().ravel()[arcs],
                )
            )
        return tuple(found)

    @cached_property
    def heard(self) -> int:
        """For how many neighbours the program has room, at least one."""
        return max(1, *(len(one.senders) for one in self.links))

    @property
    def distributed(self) -> bool:
        """Whether innovations of neighbours count: the observer (22)."""
        return bool(self.law.weights.heard_innovation.data.any())

    def weights(self, i: int) -> dict[str, Array]:
        """Return the weights of agent i by name, with room for all neighbours."""
        one, count = self.links[i], len(self.links[i].senders)
        weight, innovation = np.zeros(self.heard), np.zeros(self.heard)
        weight[:count], innovation[:count] = one.weight, one.innovation_weight
        return {
            "own": np.array(one.own),
            "leader": np.array(one.leader),
            "weight": weight,
            "own_innovation": np.array(one.own_innovation),
            "innovation_weight": innovation,
        }

    def files(self) -> dict[str, str]:
        """Return the controller as C by file name; ``controller_data.h`` has its constants.

        Raises
        ------
        InputError
            If it cannot be had in C.
        """
        engine = self.law.sources().files
        taken = {name: engine[name] for name in _OF_THE_ENGINE if name in engine}
        return taken | {"controller_data.h": self._data()}

    def _data(self) -> str:
        members = self.law.members(self.h).items()
        rows = "\n".join(f"    .{name} = {braced(value)}," for name, value in members)
        return f"""\
/* The gains and the sampled model; generated. */
#ifndef CONTROLLER_DATA_H
#define CONTROLLER_DATA_H

#include <math.h>

#include "controller.h"

#define HEARD {self.heard} /* neighbours that there is room for */
#define DISTRIBUTED {int(self.distributed)} /* observer (22): innovations of neighbours count */

static const Controller CONTROLLER = {{
{rows}
}};

#endif
"""


def braced(value: Any) -> str:
    """Write a number, or the numbers of an array row by row, as C has them.

    Examples
    --------
    >>> braced(np.array([[0.1, -np.inf]]))
    '{0.1, -INFINITY}'
    """
    numbers = np.asarray(value, dtype=float)
    text = ", ".join(_number(number) for number in numbers.ravel().tolist())
    return f"{{{text}}}" if numbers.ndim else text


def _number(value: float) -> str:
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(value)
