"""Every way of coupling on a mock FMU made of functions, against its recursion by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from fmu_examples import tank_fmu
from fmu_scenarios import one_fmu

from posmas_fmi import load, run
from posmas_fmi.agent import linear_agent
from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import Iteration, System, simulate
from posmas_fmi.cosim.plant import CallablePlant
from posmas_fmi.cosim.wiring import Extra, Term, Wiring
from posmas_fmi.errors import InputError
from posmas_fmi.network import network_from_arcs
from posmas_fmi.protocol import make_protocol
from posmas_fmi.scenario.compare import together
from posmas_fmi.scenario.main_job import scheduled
from posmas_fmi.scenario.tables import CompareTable

H, STEPS = 0.1, 20
DECAY = np.exp(-H)
HOLD, RAMP = 1 - DECAY, H - 1 + DECAY  # what an input of 1, and one that rises by 1/s, adds
COUPLINGS: dict[str, dict[str, Any]] = {
    "jacobi": {},
    "gauss-seidel": {"stages": (np.array([0]), np.array([1]))},
    "iterate": {"iteration": Iteration(1e-13, 60)},
}


def coupled(coupling: str, rates: bool) -> np.ndarray:
    """x' = -x + 0.5 z, z' = -z + 0.5 x: the first is an agent without control; (STEPS + 1, 2)."""
    one, agent = network_from_arcs(1, [], [1]), linear_agent([[-1.0]], [[1.0]], [[1.0]])
    feeds = [(Term(2, 0.5),), (Term(0, 0.5),)]
    extras = [
        (Extra(feed, has_rate=rates), *((Extra(feed, is_rate=True),) if rates else ()))
        for feed in feeds
    ]
    definition = System(
        agent,
        one,
        ProtocolLaw(agent, make_protocol(one, [[0.0]], [[0.0]], 1.0)),
        Channel.uniform(1, H),
        Clock.of(H * STEPS, H),
        np.zeros((1, 1)),
        np.zeros(1),
        wiring=Wiring(
            (extras[0], (Extra(()), *extras[1])), np.zeros((1, 0), dtype=np.int64), recorded=(0, 2)
        ),
        **COUPLINGS[coupling],
    )

    def advance(t: float, h: float, x: np.ndarray, U: np.ndarray) -> np.ndarray:
        slope = U[:, 2:3] if rates else 0.0
        return DECAY * x + HOLD * (U[:, :1] + U[:, 1:2]) + RAMP * slope

    plant = CallablePlant(lambda x: x, advance, np.array([[2.0], [0.0]]), 2 + rates)
    rows: list[np.ndarray] = []
    outcome = simulate(definition, plant, lambda t, row: rows.append(row["extra"].copy()))
    assert outcome.ended == "complete"
    return np.array(rows)


def by_hand(coupling: str, rates: bool) -> np.ndarray:
    x, z = 2.0, 0.0
    before = (x, z)
    rows = [before]
    for _ in range(STEPS):
        # what an input gets that begins at a and is known, or taken, to change by d over the step
        def moved(own: float, a: float, d: float) -> float:
            return DECAY * own + 0.5 * (HOLD * a + (RAMP * d / H if rates else 0.0))

        dx, dz = x - before[0], z - before[1]
        before = (x, z)
        if coupling == "jacobi":
            x, z = moved(x, z, dz), moved(z, x, dx)
        elif coupling == "gauss-seidel":
            new = moved(x, z, dz)
            x, z = new, moved(z, x if rates else new, new - x)
        else:  # the values at the end of the step are those that the inputs are made of
            a, b = (HOLD - RAMP / H, RAMP / H) if rates else (0.0, HOLD)
            matrix = np.array([[1.0, -0.5 * b], [-0.5 * b, 1.0]])
            right = [DECAY * x + 0.5 * a * z, DECAY * z + 0.5 * a * x]
            x, z = np.linalg.solve(matrix, right)
        rows.append((float(x), float(z)))
    return np.array(rows)


@pytest.mark.parametrize("rates", [False, True])
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_each_coupling_is_its_recursion(coupling: str, rates: bool) -> None:
    found, expected = coupled(coupling, rates), by_hand(coupling, rates)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)


def test_they_differ_and_slopes_come_closer() -> None:
    t = H * np.arange(STEPS + 1)
    exact = np.stack([np.exp(-0.5 * t) + np.exp(-1.5 * t), np.exp(-0.5 * t) - np.exp(-1.5 * t)])
    for coupling in COUPLINGS:
        held, sloped = (np.abs(by_hand(coupling, r) - exact.T).max() for r in (False, True))
        assert sloped < 0.3 * held, (coupling, held, sloped)


@pytest.mark.parametrize(("gain", "unsettled"), [(0.5, 0), (1.5, 10)])
def test_an_iteration_that_does_not_settle_is_told(
    tmp_path: Path, gain: float, unsettled: int
) -> None:
    """A tank whose power follows its own surplus at once: a loop that contracts, or does not."""
    more = f"""
[[component]]
name = "hall"
fmu = "{tank_fmu(tmp_path, 3).name}"
record = ["power", "net"]

[[connection]]
source = "hall.net"
to = "hall.power"
scale = {gain}
offset = 10.0
"""
    engine = 'auto"\ncoupling = "iterate'
    path = one_fmu(tmp_path, tank_fmu(tmp_path, 3), '"power"', '"temperature"', more, engine=engine)
    told = scheduled(load(path)).to_text()
    assert "loop: hall on itself" in told
    assert "algebraic loop, repeated until it settles: hall.net -> hall.power -> hall.net" in told
    made = run(load(path), tmp_path / "out", report=False)
    summary = made.summary
    assert summary["unsettled_steps"] == unsettled
    assert ("did not settle in 10 of 10 steps" in summary["reason"]) == bool(unsettled)
    assert made.certified == "yes"
    assert {agent["status"] for agent in summary["agents"]} == {"converged"}
    assert summary["verdict"] == ("not settled" if unsettled else "converged")
    assert made.good is not bool(unsettled)  # the exit code
    both = together({"a": {**summary, "unsettled_steps": 0}, "b": summary}, CompareTable(["a"]))
    assert both["verdict"] == ("not settled" if unsettled else "compared")
    assert both["reason"] == ("b: not settled" if unsettled else "")
    if not unsettled:
        with xr.open_dataset(tmp_path / "out" / "results.nc") as found:
            power, net = found["hall.power"].values[1:], found["hall.net"].values[1:]
        np.testing.assert_allclose(power, gain * net + 10.0, rtol=1e-7)


def test_an_input_is_set_by_one_thing(tmp_path: Path) -> None:
    more = '[[connection]]\nsource = "2.net"\nto = "1.power"'
    path = one_fmu(tmp_path, tank_fmu(tmp_path, 3), '"power"', '"temperature"', more)
    with pytest.raises(InputError, match=r"1: the input 'power' is set by the control law already"):
        scheduled(load(path))
