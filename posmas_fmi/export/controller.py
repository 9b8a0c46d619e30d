"""The controllers of a network as they are shipped: one program, and the data of each agent."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import attrs
import numpy as np

from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.expression import Array
from posmas_fmi.fmu.model import Experiment, FmuModel, Variable

CSRC = Path(__file__).parent / "csrc"
_OF_THE_ENGINE = ("controller.c", "controller.h", "step.h", "lanes.h", "agent_functions.h")


@attrs.frozen(eq=False)
class Links:
    """Whom an agent hears, and with which weights; the parameters of its controller.

    Attributes
    ----------
    senders : tuple of int
        The agents that it hears, counted from 0.
    own, leader : float
        Weights in (6), φ included, of its own estimate and of the leader; 0: does not hear it.
    weight : (senders,) array
        Of each sender's estimate.
    own_innovation : float
    innovation_weight : (senders,) array
        Weights in the distributed observer (22).
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
    law : ProtocolLaw
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
    >>> from posmas_fmi.network import network_from_arcs
    >>> from posmas_fmi.protocol import make_protocol
    >>> pair = network_from_arcs(2, [(1, 2)], pinned=[1])
    >>> protocol = make_protocol(pair, K=[[-1.0]], E=[[0.5]], phi=2.0)
    >>> law = ProtocolLaw(linear_agent([[-1.0]], [[1.0]], [[1.0]]), protocol)
    >>> controllers = Controllers(law, pair.adjacency.indices, 0.1, np.zeros((2, 1)), np.ones(1))
    >>> [(one.senders, one.own, one.leader) for one in controllers.links]
    [((), 2.0, 2.0), ((0,), 2.0, 0.0)]
    """

    law: ProtocolLaw
    senders: np.ndarray[tuple[int], np.dtype[np.int64]]
    h: float
    xhat0: Array
    s0: Array

    @property
    def distributed(self) -> bool:
        """Whether innovations are sent besides estimates: observer (22)."""
        return bool(self.law.weights.heard_innovation.data.any())

    @property
    def sent(self) -> int:
        """Length of a message."""
        return self.law.agent.m + (self.law.agent.q if self.distributed else 0)

    @cached_property
    def links(self) -> tuple[Links, ...]:
        """Of each agent."""
        weights, found = self.law.weights, []
        heard, innovation = weights.heard.tocsr(), weights.heard_innovation.tocsr()
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

    def parameters(self, i: int) -> dict[str, Array]:
        """Return the parameters of agent i's controller by name, with room for all neighbours."""
        one, room = self.links[i], np.zeros(self.heard)
        count = len(one.senders)
        weight, innovation = room.copy(), room.copy()
        weight[:count], innovation[:count] = one.weight, one.innovation_weight
        found = {"own": one.own, "leader": one.leader, "weight": weight}
        if self.distributed:
            found |= {"own_innovation": one.own_innovation, "innovation_weight": innovation}
        return {name: np.asarray(value, dtype=float) for name, value in found.items()}

    def first(self, i: int) -> dict[str, Array]:
        """Return what agent i knows at the start: how it, its neighbours and the leader begin."""
        heard = np.zeros((self.heard, self.sent))
        for k, sender in enumerate(self.links[i].senders):
            heard[k, : self.law.agent.m] = self.xhat0[sender]
        return {"xhat": self.xhat0[i], "heard": heard, "s": self.s0}

    def files(self) -> dict[str, str]:
        """Return the C program by file name: `agent.h` is what a user calls.

        Raises
        ------
        InputError
            If g or sec are Python functions.
        """
        engine = self.law.sources().files
        own = {name: (CSRC / name).read_text(encoding="utf-8") for name in ("agent.h", "agent.c")}
        taken = {name: engine[name] for name in _OF_THE_ENGINE}
        return taken | own | {"controller_data.h": self._data()}

    def _data(self) -> str:
        members = self.law.members(self.h).items()
        rows = "\n".join(f"    .{name} = {braced(value)}," for name, value in members)
        return f"""\
/* The gains and the sampled model; generated. */
#ifndef CONTROLLER_DATA_H
#define CONTROLLER_DATA_H

#include "controller.h"

#define HEARD {self.heard}             /* neighbours that there is room for */
#define DISTRIBUTED {int(self.distributed)}       /* observer (22): innovations are sent as well */

static const Controller CONTROLLER = {{
{rows}
}};

#endif
"""


def braced(value: Array | float) -> str:
    """Write a number, or the numbers of an array row by row, as C has them.

    Examples
    --------
    >>> braced(np.array([[0.1, 2.0]]))
    '{0.1, 2.0}'
    """
    numbers = np.asarray(value, dtype=float)
    text = ", ".join(repr(number) for number in numbers.ravel().tolist())
    return f"{{{text}}}" if numbers.ndim else text


def controller_model(controllers: Controllers, name: str = "controller") -> FmuModel:
    """Return the FMU of the controller of any agent of the network; see ``csrc/agent.h``.

    Parameters
    ----------
    controllers : Controllers
    name : str, optional
        C identifier.

    Returns
    -------
    FmuModel
        Sampled: one period is one communication step. Parameters own, leader, weight (heard) and,
        with the distributed observer, own_innovation and innovation_weight (heard), those of no
        agent until they are set, see `Controllers.parameters`. Inputs y (q), heard (heard, sent)
        and s (m); state xhat (m); outputs u (p), which an agent holds over the next period, and
        sent (sent), which its neighbours hear.

    Raises
    ------
    InputError
        If g or sec are Python functions.
    """
    agent, heard, sent = controllers.law.agent, controllers.heard, controllers.sent
    m, p, q = agent.m, agent.p, agent.q

    def given(name: str, role: str, shape: tuple[int, ...], what: str) -> Variable:
        start = (0.0,) * int(np.prod(shape))
        return Variable(name, role, shape, start, description=what)  # type: ignore[arg-type]

    def computed(name: str, role: str, size: int, what: str) -> Variable:
        return Variable(name, role, (size,), description=what, depends=())  # type: ignore[arg-type]

    variables = [
        given("own", "parameter", (), "Weight of the own estimate in (6)"),
        given("leader", "parameter", (), "Weight of the leader; 0: not pinned"),
        given("weight", "parameter", (heard,), "Weights of the neighbours' estimates"),
        given("y", "input", (q,), "Measured"),
        given("heard", "input", (heard, sent), "Last message of each neighbour"),
        given("s", "input", (m,), "Last state of the leader"),
        given("xhat", "state", (m,), "Estimate"),
        computed("disagreement", "memory", m, "Weighted disagreement, from which u follows"),
        computed("u", "output", p, "Input of the agent, held over the period that begins"),
        computed("sent", "output", sent, "Message to those that hear this agent"),
        computed("sec_u", "local", p, "What the observer takes u for"),
    ]
    if controllers.distributed:
        variables += [
            given("own_innovation", "parameter", (), "Weight of the own innovation in (22)"),
            given("innovation_weight", "parameter", (heard,), "Weights of those of neighbours"),
            computed("innovation", "memory", q, "y - C xhat at the last communication point"),
        ]
    h = controllers.h
    return FmuModel(
        name,
        f"Observer and controller of one agent, period {h:g} s",
        tuple(variables),
        controllers.files() | {"model.c": (CSRC / "model.c").read_text(encoding="utf-8")},
        Experiment(stop=1000 * h, step=h),
        period=h,
    )
