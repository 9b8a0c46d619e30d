from __future__ import annotations

import attrs
import numpy as np
import pytest
from scipy.linalg import expm

from posmas_fmi.certify import Loop, certify_loop
from posmas_fmi.certify.band import guaranteed_band
from posmas_fmi.certify.closed_loop import Prover
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


@pytest.mark.parametrize("observer", ["local", "distributed"])
@pytest.mark.parametrize("period", [0.005, None])
def test_region_of_attraction_is_invariant_with_estimation_errors(
    observer: str, period: float | None
) -> None:
    """Worst sector gains and Θ, start on the boundary: the region is never left."""
    limit, h = 2.0, period or 1e-4
    loop = attrs.evolve(LOOP, observer=observer, mu=15.0, period=period)
    if observer == "distributed":
        given = DesignSettings(phi=10.0, observer="distributed", mu=15.0)
        loop = attrs.evolve(loop, E=design(loop.agent, loop.network, given, 0.005).E)
    certificate = certify_loop(loop, saturation=limit)
    region = certificate.region_of_attraction
    assert region is not None
    assert 0 < region.radius_estimation < np.inf
    sharp, plain = loop.weights_perron, loop.weights
    observing = Prover(loop, loop.estimator(sharp), sharp).contraction
    tracking = Prover(loop, loop.controller(plain), plain).contraction
    box = region.c * np.outer(tracking.nu, tracking.v)
    box_e = region.c_estimation * np.outer(observing.nu, observing.v)
    agent, rng = loop.agent, np.random.default_rng(4)
    L_p = loop.network.pinned_laplacian.toarray()
    M = np.eye(4) if observer == "local" else loop.mu * L_p
    for draw in range(8):
        sign = 1.0 if draw == 0 else rng.choice([-1.0, 1.0], (4, 2))
        share = rng.random()
        delta, e = sign * share * box, sign * (1 - share) * box_e
        for _ in range(25):
            Phi, Gamma, gains = periods(rng, attrs.evolve(loop, period=h))
            u = loop.phi * (L_p @ delta @ loop.K.T)
            assert np.abs(u).max() <= limit / agent.sector[0] * (1 + 1e-9)
            innovation = M @ e @ (loop.E @ agent.C).T
            push = gains * u @ agent.B.T + innovation
            delta, e = (
                np.einsum("nij,nj->ni", Phi, z) + np.einsum("nij,nj->ni", Gamma, w)
                for z, w in ((delta, push), (e, -innovation))
            )
            assert (np.abs(delta) / box).max() + (np.abs(e) / box_e).max() <= 1 + 1e-9


def test_larger_estimation_errors_leave_the_region() -> None:
    """Outside, with both shares 1, e pushes δ beyond c within a period."""
    region = certify_loop(LOOP, saturation=2.0).region_of_attraction
    assert region is not None
    plain, sharp = LOOP.weights, LOOP.weights_perron
    tracking = Prover(LOOP, LOOP.controller(plain), plain).contraction
    observing = Prover(LOOP, LOOP.estimator(sharp), sharp).contraction
    delta = region.c * np.outer(tracking.nu, tracking.v)
    e = region.c_estimation * np.outer(observing.nu, observing.v)
    agent = LOOP.agent
    W = expm(np.block([[agent.A + np.abs(agent.H), np.eye(2)], [np.zeros((2, 4))]]) * 0.005)
    u = agent.sector[0] * LOOP.phi * (LOOP.network.pinned_laplacian @ delta @ LOOP.K.T)
    push = u @ agent.B.T + e @ (LOOP.E @ agent.C).T
    after = delta @ W[:2, :2].T + push @ W[:2, 2:].T
    assert (after > delta).any()


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
