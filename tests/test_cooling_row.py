"""A row of lines on one facility header: FMUs, loads and the cooling controllers together."""

from __future__ import annotations

import numpy as np
import pytest

from posmas_fmi.cooling import Loads, generate_loads
from posmas_fmi.cooling.control import controller
from posmas_fmi.cooling.row import Row, simulate_row
from posmas_fmi.network import network_from_arcs


def row(name: str, **changes: object) -> Row:
    n = 4
    arcs = [(i, (i + hop - 1) % n + 1) for hop in (1, 2) for i in range(1, n + 1)]
    power = np.array([[80e3] * n, [50e3, 70e3, 95e3, 110e3]])
    given = {"sensor": None, "delay": 5.0, "shortage": 1.0} | changes
    loads = Loads(np.array([0.0, 60.0]), power)
    return Row(network_from_arcs(n, arcs, [1]), loads, controller(name), until=600.0, **given)


@pytest.mark.parametrize(
    "name", ["fixed", "printed", "proportional", "integral", "integral_ff", "pi"]
)
def test_the_engine_agrees_with_the_numpy_statement(name: str) -> None:
    """They measure the facility's temperature, which is read from another FMU."""
    expected = simulate_row(row(name), wanted="numpy")
    for threads in (1, 2):
        actual = simulate_row(row(name), wanted="c", threads=threads)
        assert actual.outcome.ended == expected.outcome.ended == "complete"
        np.testing.assert_allclose(actual.supply, expected.supply, rtol=0, atol=1e-6)
        np.testing.assert_allclose(actual.valve, expected.valve, rtol=0, atol=1e-8)
    assert np.ptp(expected.supply[-1]) > 1e-3


def test_integral_action_brings_the_lines_together() -> None:
    spread = {
        n: np.ptp(simulate_row(row(n)).supply[-1]) for n in ("fixed", "proportional", "integral")
    }
    assert spread["integral"] < 0.5 * spread["proportional"] < 0.5 * spread["fixed"]


@pytest.mark.parametrize("seed", [1, 2])
def test_feedforward_takes_out_loads_that_all_lines_share(seed: int) -> None:
    """One of eight lines is pinned; an hour or more of swings between 0.27 and 0.93 of 130 kW."""
    arcs = [(i, (i + hop - 1) % 8 + 1) for hop in (1, 2) for i in range(1, 9)]
    network, until = network_from_arcs(8, arcs, [1]), 10800.0
    loads = generate_loads(8, until, seed=seed)
    assert np.ptp(loads.power.mean(axis=1)) > 60e3
    rms = {
        name: simulate_row(Row(network, loads, controller(name), until, delay=5.0)).figures().rms
        for name in ("integral", "integral_ff")
    }
    assert rms["integral_ff"] < 0.1 < 5 * rms["integral_ff"] < rms["integral"]
