from __future__ import annotations

import attrs
import numpy as np
import pytest
from scipy.linalg import expm

from posmas_fmi.certify import Loop, certify_loop
from posmas_fmi.certify.band import guaranteed_band
from posmas_fmi.certify.flow import Flow
from posmas_fmi.design import DesignSettings, design
from posmas_fmi.design.paper_examples import EXAMPLE_1

LOOP = Loop(
    EXAMPLE_1.agent("tanh"),
    EXAMPLE_1.network(2),
    np.array([[-0.541353, -0.548052]]),
    np.array(EXAMPLE_1.designs[1].E),
    phi=10.0,
    period=0.005,
)


def periods(rng: np.random.Generator, loop: Loop) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random Φ, Γ and sector gains of every agent for one period."""
    agent, h = loop.agent, loop.period
    assert h is not None
    W = []
    for _ in range(loop.network.N):
        G = np.diag(rng.choice([-1.0, 1.0], agent.m))
        J = agent.A + agent.H @ G
        W.append(expm(np.block([[J, np.eye(2)], [np.zeros((2, 4))]]) * h))
    stacked = np.array(W)
    return stacked[:, :2, :2], stacked[:, :2, 2:], rng.choice(agent.sector, (loop.network.N, 1))


def test_no_disturbance_leaves_the_band() -> None:
    rng = np.random.default_rng(5)
    w = np.array([0.3, 0.1])
    band = guaranteed_band(LOOP, w)
    assert band is not None
    L_p = LOOP.network.pinned_laplacian.toarray()
    z = band * rng.uniform(-1, 1, band.shape)
    for _ in range(300):
        Phi, Gamma, M = periods(rng, LOOP)
        u = M * LOOP.phi * (L_p @ z @ LOOP.K.T)
        push = u @ LOOP.agent.B.T + w * np.sign(z)
        z = np.einsum("nij,nj->ni", Phi, z) + np.einsum("nij,nj->ni", Gamma, push)
        assert (np.abs(z) <= band * (1 + 1e-9)).all()


def test_band_is_not_wildly_pessimistic() -> None:
    """The slowest nonlinearity with a constant disturbance reaches most of the band."""
    w = np.array([0.1, 0.1])
    band = guaranteed_band(attrs.evolve(LOOP, period=None), w)
    assert band is not None
    agent = LOOP.agent
    L_p = LOOP.network.pinned_laplacian.toarray()
    J = np.kron(np.eye(4), agent.A + np.abs(agent.H)) + LOOP.phi * agent.sector[0] * np.kron(
        L_p, agent.B @ LOOP.K
    )
    reached = np.linalg.solve(-J, np.tile(w, 4)).reshape(4, 2)
    assert (reached <= band).all()
    assert band == pytest.approx(reached, rel=1e-4)


def test_band_needs_a_contracting_loop() -> None:
    assert guaranteed_band(attrs.evolve(LOOP, K=0 * LOOP.K), np.ones(2)) is None


def test_region_of_attraction_keeps_inputs_in_the_sector() -> None:
    rng = np.random.default_rng(2)
    limit = 2.0
    certificate = certify_loop(LOOP, "perron", saturation=limit)
    region = certificate.region_of_attraction
    assert region is not None
    assert 0 < region.radius < np.inf
    L_p = LOOP.network.pinned_laplacian.toarray()
    for _ in range(500):
        delta = rng.choice([-1.0, 1.0], (4, 2)) * region.radius
        u = LOOP.phi * L_p @ delta @ LOOP.K.T
        assert np.abs(u).max() <= limit / LOOP.agent.sector[0] * (1 + 1e-9)


def test_band_objective_is_not_wider_than_the_fastest_design() -> None:
    w = (0.05, 1.0)
    common = {"phi": 10.0, "disturbance": w}
    fast = design(EXAMPLE_1.agent(), EXAMPLE_1.network(2), DesignSettings(**common), 0.005)
    narrow = design(
        EXAMPLE_1.agent(), EXAMPLE_1.network(2), DesignSettings(objective="band", **common), 0.005
    )
    assert fast.certificate.band is not None
    assert narrow.certificate.band is not None
    assert np.max(narrow.certificate.band) <= np.max(fast.certificate.band) * (1 + 1e-6)


def test_held_response_bounds_are_ordered() -> None:
    low, high, held_low, held_high = Flow(LOOP.A_low, LOOP.A_high).over(0.005)
    assert (low.low <= high.high).all()
    assert (held_low.low <= held_high.high).all()
