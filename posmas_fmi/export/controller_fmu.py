"""The controller of any agent of a network as an FMU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.errors import InputError
from posmas_fmi.export.controllers import Controllers
from posmas_fmi.expression import Array
from posmas_fmi.fmu.model import Experiment, FmuModel, Role, Variable

_MODEL = Path(__file__).parent / "csrc" / "model.c"


def controller_model(controllers: Controllers, name: str = "controller") -> FmuModel:
    """Return the FMU of the controller of any agent of the network; see ``csrc/model.c``.

    Parameters
    ----------
    controllers : Controllers
        Of the protocol.
    name : str, optional
        C identifier.

    Returns
    -------
    FmuModel
        Sampled: one period is one communication step. Parameters own, leader, weight (heard) and,
        with the distributed observer, own_innovation and innovation_weight (heard), those of no
        agent until they are set, see `values`. Inputs y (q), heard (heard, sent) and s (m); state
        xhat (m); outputs u (p), which an agent holds over the next period, and sent (sent), which
        its neighbours hear: the estimate, and the innovation where it is distributed.

    Raises
    ------
    InputError
        If the law is another one: one whose input follows what is measured at the same time. Or if
        g or sec are Python functions.
    """
    agent, heard, sent = _law(controllers).agent, controllers.heard, _sent(controllers)

    def given(name: str, role: Role, shape: tuple[int, ...], what: str) -> Variable:
        return Variable(name, role, shape, (0.0,) * int(np.prod(shape)), description=what)

    def computed(name: str, role: Role, size: int, what: str) -> Variable:
        return Variable(name, role, (size,), description=what, depends=())

    variables = [
        given("own", "parameter", (), "Weight of the own estimate in (6)"),
        given("leader", "parameter", (), "Weight of the leader; 0: not pinned"),
        given("weight", "parameter", (heard,), "Weights of the neighbours' estimates"),
        given("y", "input", (agent.q,), "Measured"),
        given("heard", "input", (heard, sent), "Last message of each neighbour"),
        given("s", "input", (agent.m,), "Last state of the leader"),
        given("xhat", "state", (agent.m,), "Estimate"),
        computed("disagreement", "memory", agent.m, "Weighted disagreement; u follows from it"),
        computed("u", "output", agent.p, "Input of the agent, held over the period that begins"),
        computed("sent", "output", sent, "Message to those that hear this agent"),
        computed("sec_u", "local", agent.p, "What the observer takes u for"),
    ]
    if controllers.distributed:
        variables += [
            given("own_innovation", "parameter", (), "Weight of the own innovation in (22)"),
            given("innovation_weight", "parameter", (heard,), "Weights of those of neighbours"),
            computed("innovation", "memory", agent.q, "y - C xhat at the last point"),
        ]
    h = controllers.h
    return FmuModel(
        name,
        f"Observer and controller of one agent, period {h:g} s",
        tuple(variables),
        controllers.files() | {"model.c": _MODEL.read_text(encoding="utf-8")},
        Experiment(stop=1000 * h, step=h),
        period=h,
    )


def values(controllers: Controllers, i: int) -> dict[str, Array]:
    """Return the parameters of agent i by name, and how it, its neighbours and the leader begin."""
    found = controllers.weights(i)
    if not controllers.distributed:
        del found["own_innovation"], found["innovation_weight"]
    heard = np.zeros((controllers.heard, _sent(controllers)))
    for k, sender in enumerate(controllers.links[i].senders):
        heard[k, : controllers.xhat0.shape[1]] = controllers.xhat0[sender]
    return found | {"xhat": controllers.xhat0[i], "heard": heard, "s": controllers.s0}


def _sent(controllers: Controllers) -> int:
    """Length of a message."""
    agent = _law(controllers).agent
    return agent.m + (agent.q if controllers.distributed else 0)


def _law(controllers: Controllers) -> ProtocolLaw:
    law: Any = controllers.law
    if not isinstance(law, ProtocolLaw):
        raise InputError(
            "the input of this law follows what is measured at the same time; only the protocol "
            "(6) is exported as an FMU",
            "$.control.law",
        )
    return law
