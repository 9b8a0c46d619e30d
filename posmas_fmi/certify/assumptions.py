"""What a certificate takes from outside: bounds of the agent, and where they are known to hold."""

from __future__ import annotations

import math

import attrs
import numpy as np

from posmas_fmi.agent import Agent, Assumption
from posmas_fmi.certify.loop import Loop


def assumptions(loop: Loop) -> tuple[Assumption, ...]:
    """Collect every assumption of a certificate for that loop."""
    found = list(loop.agent.assumptions())
    region = _region(loop.agent, found)
    if region is not None:
        found.append(region)
    if loop.observer == "distributed" and loop.network.adjacency.nnz:
        found.append(_innovation(loop))
    return tuple(found)


def _innovation(loop: Loop) -> Assumption:
    """Whether the innovation of the distributed observer keeps its sign.

    ``f_i = Σ_j (L_p)_ij e_j`` obeys ``f_i' = A f_i - μ EC Σ_j (L_p)_ij f_j`` where all agents have
    the same linear dynamics: the equation of e, which P keeps non-negative. With slopes of g that
    differ from agent to agent it does not close.
    """
    if (loop.H_ell.high == 0).all():
        return Assumption(
            "innovation",
            "declared",
            "estimates are proved non-negative, without delays, for starts with "
            "sum_j (Lp)_ij e_j >= 0 entry by entry, e = x - xhat (g has no slope, so that stays "
            "true); xhat(0) = 0 beside unequal x(0) can undershoot; the local observer does not "
            "need this",
        )
    return Assumption(
        "innovation",
        "declared",
        "estimates stay non-negative while EC sum_j (Lp)_ij e_j >= 0, e = x - xhat: an "
        "agent next to a neighbour with a larger error can undershoot; the local "
        "observer does not need this",
    )


def _region(agent: Agent, found: list[Assumption]) -> Assumption | None:
    """Whether the bounds on g hold everywhere or only on a region that states might leave."""
    limited = any(agent.box()[name] != (0.0, math.inf) for name in agent.box())
    lipschitz = next(a for a in found if a.name == "lipschitz")
    if not limited or agent.slopes is None or lipschitz.status == "contradicted":
        return None
    inputs = {name: r for name, r in agent.region.items() if name.startswith("u")}
    anywhere = attrs.evolve(agent, region=inputs)
    if (anywhere.lipschitz_bound <= agent.ell * (1 + 1e-12)).all() and (
        np.isfinite(anywhere.growth).all() or not np.isfinite(agent.growth).all()
    ):
        return Assumption("region", "verified", "the bounds on g hold for every x >= 0, t >= 0")
    where = ", ".join(f"{n} in [{a:g}, {b:g}]" for n, (a, b) in agent.box().items())
    return Assumption(
        "region",
        "declared",
        f"the bounds on g hold for {where}; that states stay there is not proved",
    )
