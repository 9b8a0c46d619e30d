from __future__ import annotations

import math

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from posmas_fmi.agent import linear_agent
from posmas_fmi.certify import Loop, certify_loop, general
from posmas_fmi.certify.contraction import continuous_rate
from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.sampled import sampled_factor
from posmas_fmi.certify.weights import bounded, p_weights, perron_weights
from posmas_fmi.design.paper_examples import EXAMPLE_1, EXAMPLE_2
from posmas_fmi.network import network_from_arcs

E_1 = np.array(EXAMPLE_1.designs[1].E)
# fastest gains at pin 2 for 5 ms, of the contraction design
K_1 = np.array([[-0.541353, -0.548052]])


def loop_1(**changes: object) -> Loop:
    base = Loop(EXAMPLE_1.agent(), EXAMPLE_1.network(2), K_1, E_1, phi=10.0, period=0.005)
    return attrs.evolve(base, **changes)


def test_reference_figures_of_the_printed_gains_in_continuous_time() -> None:
    loop = loop_1(K=np.array([[-0.441, -0.441]]), period=None)
    certificate = certify_loop(loop, "perron")
    assert certificate.rate == pytest.approx(0.249, abs=5e-4)
    assert certificate.observer_rate == pytest.approx(1.99, abs=5e-3)
    assert certificate.certified == "conditional"


def test_printed_gains_of_example_2_are_not_positive() -> None:
    printed = EXAMPLE_2.designs[1]
    for pin in range(1, 10):
        loop = Loop(
            EXAMPLE_2.agent(),
            EXAMPLE_2.network(pin),
            np.array(printed.K),
            np.array(printed.E),
            phi=30.0,
        )
        certificate = certify_loop(loop)
        assert certificate.certified == "no"
        assert not certificate.positive
        assert "P: A + phi m_h max(Lp)_ii BK - |H|l Metzler" in {
            c.name for c in certificate.failing
        }


def test_conditional_names_the_contradicted_bound() -> None:
    certificate = certify_loop(loop_1())
    assert certificate.certified == "conditional"
    assert [(a.name, a.status) for a in certificate.open_assumptions] == [
        ("lipschitz", "contradicted")
    ]


def test_tanh_makes_it_unconditional() -> None:
    certificate = certify_loop(loop_1(agent=EXAMPLE_1.agent("tanh")))
    assert certificate.certified == "yes"
    assert certificate.rate == pytest.approx(0.2538, abs=1e-4)


def test_printed_protocol_is_never_certified() -> None:
    certificate = certify_loop(loop_1(protocol="printed"))
    assert certificate.certified == "no"
    assert "L - D" in certificate.failing[0].name
    assert certificate.rate is None


def test_an_unreached_agent_is_a_failed_condition_with_its_name() -> None:
    network = network_from_arcs(3, [(1, 2)], pinned=[1])
    agent = linear_agent([[-1.0]], [[1.0]], [[1.0]])
    certificate = certify_loop(Loop(agent, network, np.array([[-1.0]]), np.array([[1.0]])))
    assert certificate.certified == "no"
    assert "agent(s) 3" in certificate.failing[0].detail


def test_margins_are_positive_exactly_where_conditions_hold() -> None:
    for K in (K_1, 2 * K_1, -K_1, 0 * K_1):
        for period in (None, 0.001, 0.005, 0.05):
            for c in certify_loop(loop_1(K=K, period=period)).conditions:
                assert (c.margin > 0) == c.holds


def test_one_agent_alone() -> None:
    agent = linear_agent([[0.5]], [[1.0]], [[1.0]])
    loop = Loop(agent, network_from_arcs(1, [], [1]), np.array([[-2.0]]), np.array([[3.0]]))
    certificate = certify_loop(loop)
    assert certificate.certified == "yes"
    assert certificate.rate == pytest.approx(1.5, rel=1e-6)
    assert certificate.observer_rate == pytest.approx(2.5, rel=1e-6)


def test_sampled_rate_of_a_scalar_loop_is_exact() -> None:
    agent = linear_agent([[0.5]], [[1.0]], [[1.0]])
    h = 0.1
    loop = Loop(
        agent, network_from_arcs(1, [], [1]), np.array([[-2.0]]), np.array([[3.0]]), period=h
    )
    r = math.exp(0.5 * h) - 2.0 * (math.exp(0.5 * h) - 1) / 0.5
    assert certify_loop(loop).rate == pytest.approx(-math.log(r) / h, rel=1e-6)


def test_positivity_between_samples_catches_what_the_instants_miss() -> None:
    # x' = rotation-free pair where the input overshoots only inside the period
    agent = linear_agent([[-1.0, 0.0], [40.0, -1.0]], [[1.0], [0.0]], [[1.0, 0.0], [0.0, 1.0]])
    network = network_from_arcs(1, [], [1])
    E = np.zeros((2, 2))
    late = Loop(agent, network, np.array([[-30.0, 0.0]]), E, period=0.1)
    assert not certify_loop(late).positive
    early = attrs.evolve(late, K=np.array([[-5.0, 0.0]]))
    assert certify_loop(early).positive


def test_weights_p_give_one_over_p_max_and_perron_the_smallest_eigenvalue() -> None:
    network = EXAMPLE_1.network(2)
    smallest = np.linalg.eigvals(network.pinned_laplacian.toarray()).real.min()
    assert p_weights(network).rate == pytest.approx(0.2, rel=1e-12)
    assert p_weights(network).rate < 0.2
    assert perron_weights(network).rate == pytest.approx(smallest, rel=1e-9)
    assert perron_weights(network).rate < smallest


@settings(deadline=None, max_examples=60)
@given(st.integers(2, 8), st.integers(0, 10**6))
def test_perron_weights_are_never_worse_than_p(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    arcs = {(int(rng.integers(1, k + 1)), k + 1) for k in range(1, n)}
    arcs |= {(a, b) for a, b in rng.integers(1, n + 1, (n, 2)).tolist() if a != b}
    network = network_from_arcs(n, sorted(arcs), [1])
    best, simple = perron_weights(network), p_weights(network)
    assert best.rate >= simple.rate > 0
    # exact check of the bound in rational arithmetic
    from fractions import Fraction

    L_p = [[Fraction(int(x)) for x in row] for row in network.pinned_laplacian.toarray()]
    for w in (best, simple):
        nu = [Fraction(float(x)) for x in w.nu]
        for row, own in zip(L_p, nu, strict=True):
            assert sum(a * b for a, b in zip(row, nu, strict=True)) >= Fraction(w.rate) * own


def test_a_bound_for_any_positive_vector_holds_even_if_it_proves_nothing() -> None:
    network = EXAMPLE_1.network(2)
    assert bounded(network, np.ones(4), "").rate == pytest.approx(0.0, abs=1e-14)


@pytest.mark.parametrize("pin", [2, 4])
def test_general_form_agrees_with_the_positive_one_where_both_apply(pin: int) -> None:
    loop = loop_1(network=EXAMPLE_1.network(pin))
    weights = loop.weights_perron
    feedback = loop.controller(weights)
    positive = continuous_rate(loop.A_high, feedback)
    moduli = general.continuous_rate(loop, "controller", weights)
    assert positive is not None
    assert moduli is not None
    assert moduli.value == pytest.approx(positive.value, abs=1e-6)
    sampled = sampled_factor(Flow(loop.A_low, loop.A_high), feedback, 0.005)
    coarse = general.sampled_factor(loop, "controller", weights)
    assert sampled is not None
    assert coarse is not None
    assert coarse.value >= sampled.value - 1e-9
    assert coarse.value < 1.0


def random_period(
    rng: np.random.Generator, loop: Loop, parts: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Φ and Γ of every agent for one period of a switching G(t), |G| ≤ ℓ."""
    h, m, n = loop.period, loop.agent.m, loop.network.N
    assert h is not None
    Phis, Gammas = [], []
    for _ in range(n):
        W = np.eye(2 * m)
        for _ in range(parts):
            G = rng.choice([-1.0, 0.0, 1.0, rng.uniform(-1, 1)], size=(m, m)) * loop.agent.ell
            J = loop.agent.A + loop.agent.H @ G
            W = expm(np.block([[J, np.eye(m)], [np.zeros((m, 2 * m))]]) * (h / parts)) @ W
        Phis.append(W[:m, :m])
        Gammas.append(W[:m, m:])
    return np.array(Phis), np.array(Gammas)


@pytest.mark.parametrize("observer", ["local", "distributed"])
def test_weighted_norm_falls_in_every_period_whatever_the_nonlinearities(observer: str) -> None:
    rng = np.random.default_rng(7)
    agent = EXAMPLE_1.agent("tanh")
    loop = loop_1(agent=agent, observer=observer, mu=15.0, E=np.array([[1.98, 1.40], [0.0, 2.55]]))
    assert loop.period is not None
    certificate = certify_loop(loop, "perron")
    assert not certificate.failing
    weights = loop.weights_perron
    flow = Flow(loop.A_low, loop.A_high)
    L_p = loop.network.pinned_laplacian.toarray()
    for feedback in (loop.controller(weights), loop.estimator(weights)):
        factor = sampled_factor(flow, feedback, loop.period)
        assert factor is not None
        v = weights.nu[:, None] * factor.v[None, :]
        for _ in range(40):
            Phi, Gamma = random_period(rng, loop)
            z = rng.choice([-1.0, 1.0, rng.uniform(-1, 1)], size=v.shape) * v
            if feedback.name == "controller":
                M = rng.choice([agent.sector[0], agent.sector[1]], size=(4, 1))
                u = M * loop.phi * (L_p @ z @ loop.K.T)
                held = u @ agent.B.T
            else:
                coupling = np.eye(4) if observer == "local" else loop.mu * L_p
                held = -coupling @ z @ (loop.E @ agent.C).T
            after = np.einsum("nij,nj->ni", Phi, z) + np.einsum("nij,nj->ni", Gamma, held)
            norm = np.abs(z / v).max()
            assert np.abs(after / v).max() <= factor.value * norm * (1 + 1e-12)


def test_positive_states_stay_so_between_samples() -> None:
    rng = np.random.default_rng(3)
    agent = EXAMPLE_1.agent("tanh")
    loop = loop_1(agent=agent)
    assert certify_loop(loop).positive
    assert loop.period is not None
    L, d = loop.network.laplacian.toarray(), loop.network.pinning
    for trial in range(20):
        x = rng.choice([0.0, rng.uniform(0, 2)], size=(4, 2))
        xhat, s = x * rng.uniform(0, 1, (4, 1)), rng.uniform(0, 2, 2)
        for k in range(20):
            t = k * loop.period
            u = loop.phi * (L @ xhat + d[:, None] * (xhat - s)) @ loop.K.T
            innovation = (x - xhat) @ (loop.E @ agent.C).T
            M = rng.uniform(*agent.sector, size=(4, 1))
            steps = 20
            for _ in range(steps):
                dt = loop.period / steps
                push = (M * u) @ agent.B.T
                dx = x @ agent.A.T + agent.g_numpy(t, x) @ agent.H.T + push
                dxhat = xhat @ agent.A.T + agent.g_numpy(t, xhat) @ agent.H.T + push + innovation
                x, xhat = x + dt * dx, xhat + dt * dxhat
                assert x.min() >= -1e-12, trial
                assert xhat.min() >= -1e-12, trial
                assert (x - xhat).min() >= -1e-12, trial
            s = s + loop.period * (agent.A @ s + agent.H @ agent.g_numpy(t, s[None])[0])


def test_distributed_observer_can_undershoot_so_positivity_is_conditional() -> None:
    """Neighbours with larger errors push an estimate below zero: theory.md, P, last line."""
    agent = EXAMPLE_1.agent("tanh")
    loop = loop_1(
        agent=agent, observer="distributed", mu=15.0, E=np.array([[1.98, 1.40], [0.0, 2.55]])
    )
    certificate = certify_loop(loop)
    assert certificate.certified == "conditional"
    assert "innovation" in {a.name for a in certificate.open_assumptions}
    L_p = loop.network.pinned_laplacian.toarray()
    x = np.array([[0.0, 0.0], [2.0, 2.0], [2.0, 2.0], [0.0, 0.0]])
    xhat = np.zeros_like(x)
    rate_of_estimate = L_p @ (x - xhat) @ (loop.E @ agent.C).T
    assert rate_of_estimate[0].max() < 0  # agent 1 hears 2 and 3, and starts at zero


def test_decoupled_states_have_entries_that_cannot_fail() -> None:
    agent = linear_agent([[-1.0, 0.0], [0.0, -2.0]], [[1.0], [0.0]], [[1.0, 0.0], [0.0, 1.0]])
    network = network_from_arcs(2, [(1, 2)], [1])
    E = np.diag([0.5, 0.25])
    loop = Loop(agent, network, np.array([[-0.5, 0.0]]), E, period=0.1)
    certificate = certify_loop(loop)
    assert certificate.certified == "yes"
    assert certificate.rate == pytest.approx(1.2, abs=0.2)
