from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from posmas_fmi.certify.proof import (
    dyadic,
    exactly_positive,
    identity,
    pivots,
    positive_definite,
    rational,
    refuted,
    verified_cholesky,
)


def near_boundary(n: int, seed: int, distance: float) -> np.ndarray:
    """Symmetric doubles whose smallest eigenvalue is about `distance`."""
    rng = np.random.default_rng(seed)
    Q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    values = np.append(rng.uniform(0.5, 2.0, n - 1), distance)
    M = (Q * values) @ Q.T
    return 0.5 * (M + M.T)


@settings(deadline=None, max_examples=200)
@given(
    st.integers(2, 7),
    st.integers(0, 10**9),
    st.sampled_from([1e-17, -1e-17, 1e-16, -1e-16, 3e-16, -3e-16, 1e-15, -1e-15, 1e-12, -1e-12]),
)
def test_no_false_proof_near_the_boundary(n: int, seed: int, distance: float) -> None:
    M = near_boundary(n, seed, distance)
    truth = exactly_positive(dyadic(M))
    for outcome in (positive_definite(M), verified_cholesky(M)):
        if outcome.positive:
            assert truth
        if np.isfinite(outcome.bound):
            shifted = dyadic(M) - identity(n) * Fraction(outcome.bound)
            assert exactly_positive(shifted) or outcome.bound == 5e-324
    assert positive_definite(M).positive == truth  # the rational one decides either way


def test_bounds_are_close_to_the_eigenvalue() -> None:
    M = near_boundary(12, 1, 0.25)
    for outcome in (positive_definite(M), verified_cholesky(M), positive_definite(dyadic(M))):
        assert outcome.bound == pytest.approx(0.25, rel=1e-5)
        assert outcome.bound < 0.25


def test_large_matrices_use_cholesky() -> None:
    M = near_boundary(60, 2, 0.1)
    assert "Cholesky" in positive_definite(M).method
    assert positive_definite(M).positive
    assert positive_definite(dyadic(M)).positive
    assert not positive_definite(M - 0.11 * np.eye(60)).positive


def test_decimals_are_exact_as_typed() -> None:
    # 0.1 + 0.2 == 0.3 in decimals, not in doubles
    M = rational([[0.1, 0.0], [0.0, 0.2]])
    assert M[0, 0] + M[1, 1] == Fraction(3, 10)
    assert pivots(M - identity(2) * Fraction(1, 10))[0] == 0


def test_singular_matrix_is_not_definite() -> None:
    ones = np.ones((3, 3))
    assert not positive_definite(ones).positive
    assert not verified_cholesky(ones).positive


def test_a_vector_refutes() -> None:
    assert refuted(rational([[1.0, 2.0], [2.0, 1.0]]), np.array([1.0, -1.0])) == -2


@pytest.mark.parametrize("bad", [np.inf, np.nan])
def test_what_is_not_finite_is_not_proved(bad: float) -> None:
    M = np.eye(30)
    M[0, 0] = bad
    assert not positive_definite(M).positive
