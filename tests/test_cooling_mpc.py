"""The centralised reference: it keeps the set-point, and shares a shortage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from posmas_fmi.cooling import LineParameters, Loads, controller
from posmas_fmi.cooling.mpc import Prediction, PredictiveLaw, exponentials
from posmas_fmi.cooling.row import Row, simulate_row
from posmas_fmi.errors import InputError
from posmas_fmi.network import network_from_arcs

LINE = LineParameters()
ROW = network_from_arcs(3, [(1, 2), (2, 3), (3, 1)], [1])


def run(law, loads, shortage):
    loads = Loads([0.0, 60.0], [np.full(3, 80e3), loads])
    row = Row(ROW, loads, law, until=1500.0, period=15.0, shortage=shortage, sensor=None)
    return simulate_row(row, wanted="numpy")


def test_exponentials_are_those_of_scipy() -> None:
    matrices = np.random.default_rng(1).normal(scale=3.0, size=(5, 6, 6))
    np.testing.assert_allclose(exponentials(matrices), expm(matrices), rtol=1e-9, atol=1e-9)


def test_the_header_is_the_one_of_the_plant() -> None:
    law = PredictiveLaw(LINE, ROW, size=[1.0, 0.5, 1.5], shortage=2.0)
    y = np.array([0.5, 0.7, 0.9])
    h, slope = law.header(y)
    share = (law.size * LINE.kv(y)).sum() / (law.size * LINE.kv(LINE.y0)).sum()
    assert h == pytest.approx(3.0 / (1 + 2.0 * share**2))
    for k in range(3):
        moved = law.header(y + 1e-6 * np.eye(3)[k])[0]
        assert slope[k] == pytest.approx((moved - h) / 1e-6, rel=1e-4)


@pytest.mark.slow
def test_it_holds_the_set_point_where_there_is_water() -> None:
    result = run(PredictiveLaw(LINE, ROW), [60e3, 80e3, 110e3], 0.0)
    assert result.outcome.ended == "complete"
    assert np.abs(result.supply[-1] - result.set_point[-1]).max() < 0.05


def test_it_shares_a_shortage_and_practice_does_not() -> None:
    loads = [90e3, 120e3, 170e3]
    shared = run(PredictiveLaw(LINE, ROW, shortage=3.0), loads, 3.0)
    alone = run(controller("pi"), loads, 3.0)
    assert shared.figures().worst < 0.8 * alone.figures().worst
    assert shared.figures().lowest > 0


def test_the_program_is_compiled_once() -> None:
    law = PredictiveLaw(LINE, ROW)
    assert law._program["problem"].is_dpp()
    run(law, [60e3, 80e3, 110e3], 0.0)
    assert law._program["problem"].solver_stats is not None


@pytest.mark.parametrize(
    "changes", [{"points": (4, 2)}, {"moves": (1, 4)}, {"moves": (0, 40)}, {"travel": 0.0}]
)
def test_nonsense_is_refused(changes) -> None:
    with pytest.raises(InputError):
        Prediction(**changes)
