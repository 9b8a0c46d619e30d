"""What the quadratic proofs, R and D claim, near the boundary, against exact arithmetic.

Each proof is made with the few small matrices that its module uses. Each claim is then checked on
the whole network, at all corners of what it covers, in rational numbers or with 40 digits.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import product

import attrs
import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_are, solve_discrete_lyapunov

from posmas_fmi.agent import Agent, linear_agent
from posmas_fmi.certify import Loop, certify_loop
from posmas_fmi.certify.closed_loop import Prover
from posmas_fmi.certify.delay import Rows, delayed_rate
from posmas_fmi.certify.proof import dyadic, exactly_positive, identity, positive_definite, rational
from posmas_fmi.certify.quadratic import (
    GraphScalar,
    Step,
    diagonal_scalar,
    feedback_matrix,
    graph_proof,
    prove_observer,
    prove_sampled,
    step_of,
    symmetric_scalar,
)
from posmas_fmi.design.lmi import observer_matrix
from posmas_fmi.expression import VectorFunction
from posmas_fmi.network import Network, network_from_arcs

SECTOR = (0.8, 1.2)
ENDS = tuple(Fraction(repr(x)) for x in SECTOR)
TINY = Fraction(1, 10**40)  # of what is proved strictly, the network may attain the bound
OFFSETS = (-1e-2, -1e-6, -1e-9, -1e-12, 0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-2)
seeds = st.integers(0, 10**9)


def kron(A: object, B: object) -> object:
    return np.kron(A, B)  # of objects: exact


def never_negative(M: object) -> bool:
    return exactly_positive(M + identity(len(M)) * TINY)  # type: ignore[operator, arg-type]


def some_network(rng: np.random.Generator, undirected: bool) -> Network:
    n = int(rng.integers(1, 4))
    arcs = {(int(rng.integers(1, k + 1)), k + 1) for k in range(1, n)}
    arcs |= {(a, b) for a, b in rng.integers(1, n + 1, (2, 2)).tolist() if a != b}
    if undirected:
        arcs |= {(b, a) for a, b in arcs}
    return network_from_arcs(n, sorted(arcs), sorted({1, int(rng.integers(1, n + 1))}))


def some_graph(rng: np.random.Generator, network: Network, undirected: bool) -> GraphScalar | None:
    """Graph scalar at the edge of what its proof takes."""
    if undirected:
        return symmetric_scalar(network, SECTOR)
    M = network.pinned_laplacian.toarray()
    Theta = np.linalg.solve(M.T, np.ones(network.N)) / network.p * rng.uniform(0.9, 1.1, network.N)
    T = Theta * 10 ** rng.uniform(0.3, 1.5)
    W = Theta[:, None] * M
    S = 1.0 * (W + W.T) - 0.04 * (M.T @ (T[:, None] * M)) - np.diag(Theta**2 / T)
    root = np.sqrt(Theta)
    value = float(np.linalg.eigvalsh(S / np.outer(root, root))[0])
    for offset in (1e-12, 1e-15, 0.0, -1e-15, -1e-12, -1e-6):
        gamma = value + offset * abs(value)
        proof = graph_proof(network, SECTOR, gamma, Theta, T)
        if proof.positive:
            return diagonal_scalar(network, SECTOR, gamma, Theta, T, proof)
    return None


def weighting(graph: GraphScalar, network: Network) -> object:
    if graph.kind == "symmetric":
        return rational(network.pinned_laplacian.toarray())
    out = np.full((network.N, network.N), Fraction(0), dtype=object)
    for k, value in enumerate(dyadic(graph.Theta)):
        out[k, k] = value
    return out


def gains_of(n: int) -> Iterator[object]:
    """All corners of the sector, agent by agent."""
    for corner in product(ENDS, repeat=n):
        out = np.full((n, n), Fraction(0), dtype=object)
        for k, value in enumerate(corner):
            out[k, k] = value
        yield out


@settings(max_examples=20)
@given(seeds, st.booleans())
def test_graph_scalars_hold_for_every_corner_of_the_sector(seed: int, undirected: bool) -> None:
    """``2qᵀWs + b sᵀWs ≤ -(γ - g b) q'ᵀWq' + c rᵀWr`` with ``q = q' + r``."""
    rng = np.random.default_rng(seed)
    network = some_network(rng, undirected)
    graph = some_graph(rng, network, undirected)
    if graph is None or not graph.value > 0:
        return
    W, M = weighting(graph, network), rational(network.pinned_laplacian.toarray())
    share = float(rng.choice([1e-9, 1e-3, 0.3]))
    gamma, cost = graph.left(share)
    b = Fraction(float(rng.uniform(0, 1)) * gamma / graph.reach)
    own = Fraction(gamma) - Fraction(graph.reach) * b
    for gains in gains_of(network.N):
        s = -(gains @ M)  # s = s q'
        top = -own * W - W @ s - s.T @ W - b * (s.T @ W @ s)
        side = -(s.T @ W)
        whole = np.block([[top, side], [side.T, Fraction(cost) * W]])
        assert never_negative(whole)


@pytest.mark.parametrize("n", [13, 17])
def test_graph_scalars_of_more_agents_are_never_too_large(n: int) -> None:
    """Beyond a dozen agents the proof is in floating point."""
    rng, proved = np.random.default_rng(n), 0
    for _ in range(3):
        arcs = sorted({(int(rng.integers(1, k + 1)), k + 1) for k in range(1, n)})
        network = network_from_arcs(n, arcs, [1, n])
        M = network.pinned_laplacian.toarray()
        Theta = np.linalg.solve(M.T, np.ones(n)) / network.p
        T = 5.0 * Theta
        W = Theta[:, None] * M
        S = 1.0 * (W + W.T) - 0.04 * (M.T @ (T[:, None] * M)) - np.diag(Theta**2 / T)
        root = np.sqrt(Theta)
        value = float(np.linalg.eigvalsh(S / np.outer(root, root))[0])
        exact, theta, t = rational(M), dyadic(np.diag(Theta)), dyadic(np.diag(T))
        ratio = np.diag([a * a / b for a, b in zip(dyadic(Theta), dyadic(T), strict=True)])
        low, high = ENDS
        form = (high + low) / 2 * (theta @ exact + exact.T @ theta)
        form = form - ((high - low) / 2) ** 2 * (exact.T @ t @ exact) - ratio
        for offset in (*OFFSETS, -1e-13, 1e-14):
            gamma = value + offset * abs(value)
            if graph_proof(network, SECTOR, gamma, Theta, T).positive:
                proved += 1
                assert exactly_positive(form - Fraction(gamma) * theta)
    assert proved >= 3


@settings(max_examples=16)
@given(seeds, st.booleans(), st.booleans(), st.booleans())
def test_no_rate_of_route_l_or_i_is_false(
    seed: int, undirected: bool, integral: bool, nonlinear: bool
) -> None:
    """Route L, and I on the augmented agent, with gains rounded to three digits."""
    rng = np.random.default_rng(seed)
    network = some_network(rng, undirected)
    graph = some_graph(rng, network, undirected)
    if graph is None or not graph.value > 0:
        return
    m = int(rng.integers(1, 3))
    A = np.round(rng.uniform(0, 0.5, (m, m)) - np.diag(rng.uniform(0.2, 2.0, m)), 3)
    B, H = np.round(rng.uniform(0.1, 1, (m, 1)), 3), np.round(rng.uniform(-0.3, 0.3, (m, m)), 3)
    beta = 0.25 if nonlinear else 0.0
    if integral:
        A = np.block([[A, np.zeros((m, 1))], [np.eye(1, m), np.zeros((1, 1))]])
        B, H = np.vstack([B, [[0.0]]]), np.vstack([H, np.zeros((1, m))])
    n = len(A)
    gain0 = -np.abs(rng.uniform(0.1, 1, (1, n)))
    closed = A + 0.5 * graph.value * B @ gain0
    if np.linalg.eigvals(closed).real.max() >= 0:
        return
    # K = -BᵀV of a Riccati equation: the inequality then holds with room to spare
    V = solve_continuous_are(A, B * np.sqrt(graph.value), np.eye(n), np.eye(1))
    V = np.round(0.5 * (V + V.T), 9)
    gain = rational(np.round(-(B.T @ V), 3))
    system, share = (A, B, H), 0.1
    theta = Fraction(0.5)

    def proves(kappa: float) -> bool:
        return positive_definite(
            feedback_matrix(system, gain, dyadic(V), graph, theta, Fraction(kappa), beta, share)
        ).positive

    if not proves(-20.0):
        return
    low, high = -20.0, 20.0
    for _ in range(60):
        half = 0.5 * (low + high)
        low, high = (half, high) if proves(half) else (low, half)
    W, M = weighting(graph, network), rational(network.pinned_laplacian.toarray())
    one, exact = identity(network.N), [rational(X) for X in system]
    X = kron(W, dyadic(V))
    bent = [Fraction(repr(beta)), -Fraction(repr(beta))] if nonlinear else [Fraction(0)]
    for offset in (0.0, 1e-15, 1e-12):
        kappa = low + offset * max(1.0, abs(low))
        if not proves(kappa):
            continue
        for gains in gains_of(network.N):
            slopes = [rng.choice(bent) for _ in range(network.N)]
            J = kron(one, exact[0]) + kron(gains @ M, exact[1] @ gain)
            for i, slope in enumerate(slopes):
                block = slice(i * n, i * n + n), slice(i * n, i * n + m)
                J[block] = J[block] + slope * exact[2]
            assert never_negative(-(J.T @ X + X @ J + 2 * Fraction(kappa) * X))


@settings(max_examples=15)
@given(seeds, st.sampled_from([0.0, 0.3]))
def test_no_rate_of_the_observer_of_route_l_is_false(seed: int, beta: float) -> None:
    rng = np.random.default_rng(seed)
    loop = some_loop(rng, beta)
    agent, E, P = loop.agent, rational(loop.E), dyadic(rng.uniform(0.5, 2.0, 2))
    s, b = Fraction(float(rng.uniform(0.2, 2.0))), Fraction(repr(beta))

    def proves(rate: float) -> bool:
        return positive_definite(observer_matrix(agent, E, P, s, Fraction(rate), b)).positive

    low, high = -20.0, 20.0
    for _ in range(40):
        half = 0.5 * (low + high)
        low, high = (half, high) if proves(half) else (low, half)
    if not proves(low):
        return
    D = np.diag(P)
    for slopes in product((b, -b), repeat=2):
        J = rational(agent.A) - E @ rational(agent.C) + rational(agent.H) @ np.diag(slopes)
        assert never_negative(-(J.T @ D + D @ J + 2 * Fraction(low) * D))


def some_step(rng: np.random.Generator, loose: float) -> Step:
    m, k = int(rng.integers(1, 3)), int(rng.integers(0, 2))
    A = rng.uniform(0, 0.2, (m, m)) + np.diag(rng.uniform(0.3, 0.75, m))
    B = rng.uniform(0.1, 0.5, (m, 1))
    if k:
        A = np.block([[A, np.zeros((m, 1))], [0.2 * np.eye(1, m), np.array([[0.9]])]])
        B = np.vstack([B, [[0.0]]])
    return Step(A, B, loose, loose, m)


@settings(max_examples=16)
@given(seeds, st.booleans(), st.sampled_from([0.0, 1e-12, 1e-3]))
def test_no_factor_of_the_sampled_proof_is_false(seed: int, undirected: bool, loose: float) -> None:
    rng = np.random.default_rng(seed)
    network = some_network(rng, undirected)
    graph = some_graph(rng, network, undirected)
    step = some_step(rng, loose)
    n, m = len(step.A), step.m
    if graph is None or not graph.value > 0 or np.abs(np.linalg.eigvals(step.A)).max() >= 0.98:
        return
    P = solve_discrete_lyapunov((step.A / 0.99).T, np.eye(n))
    P = 0.5 * (P + P.T)
    P = np.round(P / float((step.B.T @ P @ step.B)[0, 0]) * graph.value / (2 * graph.reach), 9)
    gain = np.round(-(step.B.T @ P @ step.A), 4)
    exact = rational(gain)

    def proves(factor: float) -> bool:
        return prove_sampled(step, exact, P, graph, factor, 1e-3, 0.05) is not None

    if not proves(2.0):
        return
    low, high = 0.0, 2.0
    for _ in range(60):
        half = 0.5 * (low + high)
        low, high = (low, half) if proves(half) else (half, high)
    W, M = weighting(graph, network), rational(network.pinned_laplacian.toarray())
    X, A, B = kron(W, dyadic(P)), dyadic(step.A), dyadic(step.B)
    for factor in (high, high - 1e-15, high - 1e-12):
        if not proves(factor):
            continue
        for gains in gains_of(network.N):
            T = kron(identity(network.N), A) + kron(gains @ M, B @ exact)
            for i in range(network.N):  # a Φ of its own for every agent, as far off as allowed
                x, y = rng.normal(size=n), rng.normal(size=m)
                off = step.loose * np.outer(x, y) / (np.linalg.norm(x) * np.linalg.norm(y))
                block = slice(i * n, i * n + n), slice(i * n, i * n + m)
                T[block] = T[block] + dyadic(off * (1 - 1e-12))
            assert never_negative(Fraction(factor) ** 2 * X - T.T @ X @ T)


def some_loop(rng: np.random.Generator, ell: float, **changes: object) -> Loop:
    """Two states; with a slope that makes A - |H|ℓ no Metzler matrix where `ell` is large."""
    A = np.round(rng.uniform(0.1, 1.0, (2, 2)) - np.diag(rng.uniform(2.0, 4.0, 2)), 3)
    B, C = np.round(rng.uniform(0.1, 1, (2, 1)), 3), np.eye(2)
    sec = VectorFunction.parse(["u1"], ["u1"])
    if ell == 0:
        agent = attrs.evolve(linear_agent(A, B, C), sector=SECTOR)
    else:
        g = VectorFunction.parse([f"{ell}*tanh(x1)", f"{ell}*tanh(x2)"], ["t", "x1", "x2"])
        H = np.round(rng.uniform(-1, 1, (2, 2)), 3)
        agent = Agent(A=A, H=H, B=B, C=C, g=g, sec=sec, sector=SECTOR, lipschitz=ell)
    network = some_network(rng, undirected=False)
    K = -np.round(rng.uniform(0.01, 0.1, (1, 2)), 4)
    E = np.round(np.diag(rng.uniform(0.05, 0.5, 2)), 4)
    loop = Loop(agent, network, K, E, phi=2.0, period=0.05)
    return attrs.evolve(loop, **changes)


def flow_of(loop: Loop, signs: np.ndarray) -> tuple[mpmath.matrix, mpmath.matrix]:
    """Φ and Γ with 40 digits, for G at a corner of its bounds."""
    h, ell = mpmath.mpf(repr(loop.period)), mpmath.mpf(float(loop.agent.ell.max()))
    A = mpmath.matrix([[mpmath.mpf(repr(float(x))) for x in row] for row in loop.agent.A])
    H = mpmath.matrix([[mpmath.mpf(repr(float(x))) for x in row] for row in loop.agent.H])
    J = A + H * mpmath.diag([ell * s for s in signs])
    whole = mpmath.zeros(4)
    whole[:2, :2], whole[0, 2], whole[1, 3] = J * h, h, h
    flow = mpmath.expm(whole)
    return flow[:2, :2], flow[:2, 2:]


@settings(max_examples=12)
@given(seeds, st.sampled_from([0.0, 0.05, 1.5]))
def test_every_flow_is_within_the_looseness_of_its_step(seed: int, ell: float) -> None:
    """Also where A - |H|ℓ is no Metzler matrix, as of a line with leakage."""
    rng = np.random.default_rng(seed)
    loop = some_loop(rng, ell)
    step = step_of(loop)
    assert step is not None
    with mpmath.workdps(40):
        for signs in product((-1, 1), repeat=2):
            Phi, Gamma = flow_of(loop, np.array(signs))
            off = Phi - mpmath.matrix(step.A.tolist())
            B = mpmath.matrix([[mpmath.mpf(repr(float(x)))] for x in loop.agent.B[:, 0]])
            held = Gamma * B - mpmath.matrix(step.B.tolist())
            assert max(mpmath.svd_r(off, compute_uv=False)) <= step.loose
            assert mpmath.norm(held) <= step.loose_input


@settings(max_examples=10)
@given(seeds, st.sampled_from([0.0, 0.05, 1.0]))
def test_no_factor_of_the_sampled_observer_is_false(seed: int, ell: float) -> None:
    rng = np.random.default_rng(seed)
    loop = some_loop(rng, ell)
    low, high = 0.5, 1.1
    for _ in range(12):
        half = 0.5 * (low + high)
        low, high = (low, half) if prove_observer(loop, half) is not None else (half, high)
    found = prove_observer(loop, high)
    if found is None:
        return
    P = dyadic(found.P)
    EC = mpmath.matrix([[mpmath.mpf(repr(float(x))) for x in row] for row in loop.E])
    with mpmath.workdps(40):
        for signs in product((-1, 1), repeat=2):
            Phi, Gamma = flow_of(loop, np.array(signs))
            T = Phi - Gamma * EC
            exact = np.array(
                [[Fraction(int(x * 2**120), 2**120) for x in T[i, :]] for i in range(2)]
            )
            left = Fraction(found.factor) ** 2 * P - exact.T @ P @ exact
            assert exactly_positive(left + identity(2) * Fraction(1, 2**100))


def entries(M: object) -> object:
    return np.array([[Fraction(repr(float(x))) for x in row] for row in M], dtype=object)  # type: ignore[attr-defined]


@settings(max_examples=8)
@given(seeds, st.sampled_from([0.0, 0.05]))
def test_regions_keep_every_input_inside_its_sector(seed: int, ell: float) -> None:
    """Certificate R: the largest input of the box, and the push of the estimation error."""
    rng = np.random.default_rng(seed)
    loop, limit = some_loop(rng, ell), float(rng.choice([0.3, 1.7]))
    region = certify_loop(loop, "perron", saturation=limit).region_of_attraction
    if region is None:
        return
    weights = loop.weights_perron
    tracking = Prover(loop, loop.controller(weights), weights).contraction
    observing = Prover(loop, loop.estimator(weights), weights).contraction
    L_p = abs(rational(loop.network.pinned_laplacian.toarray()))
    reach = L_p @ dyadic(tracking.nu)
    size = (abs(entries(loop.K)) @ dyadic(tracking.v))[0]
    most = Fraction(region.c) * Fraction(repr(loop.phi)) * size * max(reach)
    assert most <= Fraction(repr(limit)) / ENDS[0]
    with mpmath.workdps(40):
        _, Gamma = flow_of(attrs.evolve(loop, agent=_worst(loop)), np.array([1, 1]))
        EC = mpmath.matrix([[abs(mpmath.mpf(repr(float(x)))) for x in row] for row in loop.E])
        push = Gamma * EC * mpmath.matrix(observing.v.tolist())
        b = max(push[k] / mpmath.mpf(float(v)) for k, v in enumerate(tracking.v))
        b *= max(1 / mpmath.mpf(float(x)) for x in tracking.nu)
        left = 1 - mpmath.exp(-mpmath.mpf(observing.rate) * mpmath.mpf(repr(loop.period)))
        assert region.c_estimation * b <= region.c * left


def _worst(loop: Loop) -> Agent:
    """The agent with |H| for H: the upper bound of every flow."""
    return attrs.evolve(loop.agent, H=np.abs(loop.agent.H))


@settings(max_examples=15)
@given(seeds, st.sampled_from([0.0, 0.05]), st.integers(1, 30), st.booleans())
def test_no_rate_with_delays_is_false(seed: int, ell: float, steps: int, sampled: bool) -> None:
    """Certificate D row by row: the late neighbours count ``e^{λτ}`` times."""
    rng = np.random.default_rng(seed)
    loop = some_loop(rng, ell, period=0.05 if sampled else None)
    weights = loop.weights_perron
    prover = Prover(loop, loop.controller(weights), weights)
    if not prover.proved or prover.rate is None:
        return
    delay = 0.05 * steps
    rows = Rows.of(loop.network, weights)
    found = delayed_rate(loop, prover.feedback, rows, prover.rate, delay)
    if found.v is None:
        return
    high = attrs.evolve(loop, agent=_worst(loop), period=0.05)
    N = -entries(loop.agent.B) @ entries(loop.K)
    M = rational(loop.network.pinned_laplacian.toarray())
    nu = dyadic(weights.nu)
    v = mpmath.matrix(found.v.tolist())
    with mpmath.workdps(40):
        late = mpmath.exp(mpmath.mpf(found.rate) * mpmath.mpf(repr(0.05)) * steps)
        up, held_up = flow_of(high, np.array([1, 1]))
        _, held = flow_of(high, np.array([-1, -1]))
        fed = mpmath.matrix([[mpmath.mpf(x.numerator) / x.denominator for x in r] for r in N]) * v
        for i in range(loop.network.N):
            own, near = M[i] @ nu / nu[i], (M[i, i] * nu[i] - M[i] @ nu) / nu[i]
            w = _mp(own) - (late - 1) * _mp(near)
            for end in ENDS:
                g = mpmath.mpf(repr(loop.phi)) * _mp(end) * w
                if sampled:
                    after = up * v - (held if g >= 0 else held_up) * fed * g
                    allowed = mpmath.exp(-mpmath.mpf(found.rate) * mpmath.mpf("0.05")) * v
                else:
                    J = mpmath.matrix(
                        [[mpmath.mpf(repr(float(x))) for x in r] for r in loop.agent.A]
                    )
                    J += mpmath.mpf(float(loop.agent.ell.max())) * mpmath.matrix(
                        [[abs(mpmath.mpf(repr(float(x)))) for x in r] for r in loop.agent.H]
                    )
                    after, allowed = J * v - fed * g, -mpmath.mpf(found.rate) * v
                assert all(after[k] <= allowed[k] for k in range(2))


def _mp(x: Fraction) -> mpmath.mpf:
    return mpmath.mpf(x.numerator) / x.denominator


def test_a_wrong_constant_would_be_found() -> None:
    """The checks of this file have teeth: a scalar or a looseness that is too good fails them."""
    network = network_from_arcs(2, [(1, 2), (2, 1)], [1])
    graph = symmetric_scalar(network, SECTOR)
    assert graph is not None
    W, M = weighting(graph, network), rational(network.pinned_laplacian.toarray())
    s = -(ENDS[0] * M)
    good = -Fraction(graph.value) * W - W @ s - s.T @ W
    assert never_negative(good)
    assert not never_negative(good - Fraction(1, 100) * Fraction(graph.value) * W)
    loop = some_loop(np.random.default_rng(0), 1.5)
    step = step_of(loop)
    assert step is not None
    Phi, _ = flow_of(loop, np.sign(loop.agent.H[0]).astype(int))
    off = Phi - mpmath.matrix(step.A.tolist())
    assert max(mpmath.svd_r(off, compute_uv=False)) > 0.3 * step.loose
