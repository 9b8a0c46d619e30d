from __future__ import annotations

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.linalg import expm

from posmas_fmi.certify.enclosure import exp_nonnegative, matmul, point, typed
from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.weights import bounded
from posmas_fmi.network import network_from_arcs

entries = st.just(0.0) | st.floats(1e-3, 30.0)


def reference_exp(P: np.ndarray, tau: float) -> mpmath.matrix:
    with mpmath.workdps(60):
        return mpmath.expm(mpmath.matrix(P.tolist()) * mpmath.mpf(tau))


@settings(deadline=None, max_examples=15)
@given(hnp.arrays(float, (3, 3), elements=entries), st.floats(1e-6, 2.0))
def test_exponential_of_a_nonnegative_matrix_is_enclosed_tightly(P: np.ndarray, tau: float) -> None:
    E, _, _ = exp_nonnegative(point(P), np.array([tau]))
    exact = reference_exp(P, tau)
    for i in range(3):
        for j in range(3):
            assert E.low[0, i, j] <= exact[i, j] <= E.high[0, i, j]
            if exact[i, j] > 1e-12:
                width = E.high[0, i, j] - E.low[0, i, j]
                assert width <= 1e-10 * float(exact[i, j]) + 1e-16 * E.high.max()


def test_mean_of_the_exponential_solves_its_equation() -> None:
    P, tau = np.array([[1.0, 2.0], [0.5, 3.0]]), 0.3
    _, mean, second = exp_nonnegative(point(P), np.array([tau]))
    # P (1/τ)∫e^{Ps}ds = (e^{Pτ} - I)/τ
    left = matmul(point(P[None]), mean)
    right = (reference_exp(P, tau) - mpmath.eye(2)) / tau
    for i in range(2):
        for j in range(2):
            assert left.low[0, i, j] <= right[i, j] <= left.high[0, i, j]
    # P² φ₂ = (e^{Pτ} - I - Pτ)/τ²
    left = matmul(point((P @ P)[None]), second)
    right = (reference_exp(P, tau) - mpmath.eye(2) - mpmath.matrix(P.tolist()) * tau) / tau**2
    for i in range(2):
        for j in range(2):
            assert left.low[0, i, j] <= right[i, j] <= left.high[0, i, j]


def test_too_large_an_exponent_gives_up_honestly() -> None:
    E, mean, _ = exp_nonnegative(point([[1e300]]), np.array([1.0]))
    assert E.low[0, 0, 0] == 0.0
    assert np.isinf(mean.high[0, 0, 0])


def test_decimals_are_enclosed_as_typed() -> None:
    interval = typed([[0.1, 3.0]])
    with mpmath.workdps(40):
        assert interval.low[0, 0] < mpmath.mpf("0.1") < interval.high[0, 0]
    assert interval.low[0, 1] == interval.high[0, 1] == 3.0


@settings(deadline=None, max_examples=30)
@given(st.floats(0.001, 0.2), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_flow_bounds_every_switching_nonlinearity(h: float, g1: float, g2: float) -> None:
    A = np.array([[-10.18, 9.98], [10.3, -9.84]])
    H = np.array([[0.698, 0.26], [0.682, 0.34]])
    low, high, held_low, held_high = Flow(typed(A - H), typed(A + H)).over(h)

    def step(G: np.ndarray) -> np.ndarray:
        return expm(np.block([[A + H @ np.diag(G), np.eye(2)], [np.zeros((2, 4))]]) * (h / 2))

    W = step(np.array([g2, g1])) @ step(np.array([g1, g2]))  # switches half-way
    Phi, Gamma = W[:2, :2], W[:2, 2:]
    slack = 1e-12
    assert (Phi >= low.low - slack).all()
    assert (Phi <= high.high + slack).all()
    assert (Gamma >= held_low.low - slack).all()
    assert (Gamma <= held_high.high + slack).all()


def test_flow_of_an_agent_that_is_not_metzler_says_so() -> None:
    A = typed([[-1.0, -0.1], [0.0, -1.0]])
    assert not Flow(A, A).metzler


def test_weights_with_a_zero_are_refused() -> None:
    single = network_from_arcs(1, [], [1])
    with pytest.raises(ValueError, match="positive"):
        bounded(single, np.array([0.0]), "")
