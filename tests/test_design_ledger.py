from __future__ import annotations

import json

import numpy as np
import pytest
import sympy

from posmas_fmi.certify.proof import rational
from posmas_fmi.design import ledger_steps, paper
from posmas_fmi.design.ledger import ledger, to_text
from posmas_fmi.design.ledger_entry import Entry
from posmas_fmi.design.ledger_steps import riccati
from posmas_fmi.design.paper_examples import EXAMPLE_1, EXAMPLE_2, Example


@pytest.fixture(scope="module")
def entries() -> tuple[Entry, ...]:
    return ledger()


def of(entries: tuple[Entry, ...], erratum: int) -> list[Entry]:
    return [e for e in entries if e.erratum == erratum]


def test_every_erratum_is_there(entries: tuple[Entry, ...]) -> None:
    assert {e.erratum for e in entries if e.erratum} == set(range(1, 13))


@pytest.mark.parametrize(
    ("erratum", "verdict"),
    [
        (1, "contradicted"),
        (2, "contradicted"),
        (3, "infeasible"),
        (4, "contradicted"),
        (5, "contradicted"),
        (6, "reproduced"),
        (9, "contradicted"),
        (12, "rounded"),
    ],
)
def test_verdicts(entries: tuple[Entry, ...], erratum: int, verdict: str) -> None:
    assert {e.verdict for e in of(entries, erratum)} == {verdict}


def test_alpha_bounds_are_those_of_the_theory(entries: tuple[Entry, ...]) -> None:
    bounds = sorted(float(e.computed.split(">=")[1]) for e in of(entries, 4))
    assert bounds == pytest.approx([-9.07, -7.62, -6.26], abs=5e-3)


def test_what_reproduces(entries: tuple[Entry, ...]) -> None:
    good = {(e.place, e.item.split(" ")[0]) for e in entries if e.verdict == "reproduced"}
    for example in ("Example 1", "Example 2"):
        assert (example, "||H||") in good
        assert (example, "spectrum") in good
        assert (example, "E_0") in good
        for which in (1, 2):
            assert (f"{example}, Algorithm {which}", "K") in good


def test_P_of_example_2_is_printed_with_an_entry_of_example_1() -> None:
    assert round(float(riccati(EXAMPLE_1)[1, 1]), 4) == EXAMPLE_1.P[1][1]
    assert round(float(riccati(EXAMPLE_2)[1, 1]), 4) == 0.1373
    assert EXAMPLE_2.P[1][1] == EXAMPLE_1.P[1][1]


@pytest.mark.parametrize("example", [EXAMPLE_1, EXAMPLE_2])
def test_the_solution_of_14_is_proved(example: Example, monkeypatch: pytest.MonkeyPatch) -> None:
    P, proved = ledger_steps.solution_of_14(example)
    assert proved
    assert np.array(P, dtype=float) == pytest.approx(riccati(example), abs=1e-9)
    wrong = riccati(example) + np.diag([0.0, 1e-4])
    monkeypatch.setattr(ledger_steps, "riccati", lambda _: wrong)
    assert not ledger_steps.solution_of_14(example)[1]


def test_a_printed_root_that_is_off_by_a_digit_is_seen() -> None:
    square = sympy.Poly(sympy.Symbol("x") ** 2 - 2)
    assert ledger_steps.changes_sign(square, 1.4142)
    assert not ledger_steps.changes_sign(square, 1.4143)


def test_infeasibility_vector_is_exact() -> None:
    w = paper.infeasible(EXAMPLE_1.agent())
    assert w is not None
    assert (w > 0).all()
    assert all(x >= 0 for x in rational(w) @ rational(EXAMPLE_1.A))
    assert paper.infeasible(EXAMPLE_2.agent()) is None  # its A is Hurwitz


def test_text_and_json(entries: tuple[Entry, ...]) -> None:
    text = to_text(entries)
    assert "(erratum 12)" in text
    again = json.loads(json.dumps([e.to_dict() for e in entries], allow_nan=False))
    assert len(again) == len(entries)


def test_recovered_topologies_have_the_printed_spectra() -> None:
    for example in (EXAMPLE_1, EXAMPLE_2):
        eigenvalues = np.linalg.eigvals(example.network(1).laplacian.toarray())
        for printed in example.spectrum:
            assert np.abs(eigenvalues - printed).min() < 1e-4
