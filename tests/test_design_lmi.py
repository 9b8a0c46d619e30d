from __future__ import annotations

from typing import Any

import attrs
import numpy as np
import pytest
from scipy.linalg import expm

from posmas_fmi.agent import linear_agent
from posmas_fmi.certify import Loop, quadratic
from posmas_fmi.design import DesignSettings, design, lmi
from posmas_fmi.design.graph_scalar import graph_scalar
from posmas_fmi.design.paper_examples import EXAMPLE_1, EXAMPLE_2
from posmas_fmi.design.rounding import nearest
from posmas_fmi.design.sampled import sampled_feedback
from posmas_fmi.errors import DesignError
from posmas_fmi.network import Network, network_from_arcs


def kappa(example: object, pin: int) -> float:
    agent, network = example.agent(), example.network(pin)  # type: ignore[attr-defined]
    graph = graph_scalar(network, (agent.m_l, agent.m_h))
    # the reference figures leave |H|l out of the Metzler condition
    found = lmi.feedback_gain(agent, network, example.phi, graph, 6, agent.A)  # type: ignore[attr-defined]
    assert found.proof.positive
    return found.kappa


@pytest.mark.parametrize(("pin", "expected"), [(1, -0.31), (3, -0.82), (2, 0.668), (4, 0.668)])
def test_reference_figures_of_example_1(pin: int, expected: float) -> None:
    assert kappa(EXAMPLE_1, pin) == pytest.approx(expected, abs=6e-3)


def test_reference_figures_of_example_2() -> None:
    assert kappa(EXAMPLE_2, 1) == pytest.approx(2.05, abs=6e-3)


def test_graph_scalar_bounds_the_quadratic_form_of_every_nonlinearity() -> None:
    rng = np.random.default_rng(0)
    network = EXAMPLE_1.network(2)
    low, high = 0.9, 1.2
    found = graph_scalar(network, (low, high))
    M = network.pinned_laplacian.toarray()
    for _ in range(2000):
        q = rng.normal(size=4)
        gains = rng.uniform(low, high, 4)
        value = 2 * q @ (found.Theta * (gains * (M @ q)))
        assert value >= found.value * q @ (found.Theta * q) - 1e-9 * (q @ q)


def test_quadratic_design_is_certified_with_its_own_proofs() -> None:
    made = design(
        EXAMPLE_1.agent("tanh"),
        EXAMPLE_1.network(2),
        DesignSettings(method="lmi", phi=10.0),
        period=0.005,
    )
    names = [c.name for c in made.certificate.conditions]
    assert {"L: graph scalar", "L: feedback contracts", "L: observer contracts"} <= set(names)
    assert made.certificate.certified == "yes"
    assert made.certificate.rate is not None


def test_an_observer_is_slowed_until_it_keeps_signs_between_samples() -> None:
    """One agent alone is fast: three times its rate is too much for a period of 5 ms."""
    agent, alone = EXAMPLE_1.agent("tanh"), network_from_arcs(1, [], [1])
    made = design(agent, alone, DesignSettings(method="lmi", phi=10.0), 0.005)
    assert made.certificate.certified == "yes"
    assert made.certificate.positive
    asked = DesignSettings(method="lmi", phi=10.0, observer_rate=44.0)
    kept = design(agent, alone, asked, 0.005).certificate
    assert [c.name for c in kept.failing] == ["T: observer keeps signs for every tau <= h"]


def test_pins_that_cannot_work_say_so() -> None:
    with pytest.raises(DesignError, match="another pinned agent"):
        design(
            EXAMPLE_1.agent(), EXAMPLE_1.network(1), DesignSettings(method="lmi", phi=10.0), 0.005
        )


def test_a_panic_of_the_solver_is_a_clear_error() -> None:
    from posmas_fmi.design import solver

    class PanicException(BaseException):
        pass

    class Broken:
        status = "none"

        def solve(self, **_: object) -> None:
            raise PanicException("index out of bounds")

    with pytest.raises(DesignError, match="panicked"):
        solver.solve(Broken(), "feedback")


def test_a_solver_that_fails_is_a_clear_error() -> None:
    from posmas_fmi.design import solver

    class Broken:
        status = "solver_error"

        def solve(self, **_: object) -> None:
            raise solver.cvxpy().error.SolverError("numerical trouble")

    with pytest.raises(DesignError, match=r"the solver failed \(numerical trouble"):
        solver.solve(Broken(), "feedback")


@pytest.mark.parametrize(
    ("status", "usable"), [("optimal_inaccurate", True), ("infeasible", False)]
)
def test_a_status_only_says_whether_there_is_a_point_to_prove(status: str, usable: bool) -> None:
    from posmas_fmi.design import solver

    class Done:
        def __init__(self) -> None:
            self.status = status

        def solve(self, **_: object) -> None: ...

    assert solver.solve(Done(), "feedback") is usable


def test_an_inaccurate_point_is_not_proved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever its status says: what it leads to is refused by the proof."""
    from posmas_fmi.design import integral_gains

    solve = integral_gains.solve

    def inaccurate(problem: Any, what: str) -> bool:
        usable = solve(problem, what)
        for variable in problem.variables():
            variable.value = variable.value * 0.5 ** (variable.size == 1)
        return usable

    one = network_from_arcs(1, [], [1])
    graph = quadratic.symmetric_scalar(one, (1.0, 1.0))
    tank = linear_agent([[-0.1]], [[1.0]], [[1.0]])
    assert graph is not None
    assert integral_gains.integral_design(tank, graph, np.eye(1), 0.05).proof.positive
    monkeypatch.setattr(integral_gains, "solve", inaccurate)
    with pytest.raises(DesignError, match="could not be proved after rounding"):
        integral_gains.integral_design(tank, graph, np.eye(1), 0.05)


def test_a_solver_that_does_not_finish_is_a_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    from posmas_fmi.design import solver

    monkeypatch.setattr(solver, "TIME_LIMIT", 1e-9)
    cp = solver.cvxpy()
    X = cp.Variable((20, 20), PSD=True)
    seed = np.random.default_rng(0).normal(size=(20, 20))
    program = cp.Problem(cp.Minimize(cp.trace(X)), [X >> seed @ seed.T])
    with pytest.raises(DesignError, match="not done after"):
        solver.solve(program, "feedback")


TWO_INPUTS = linear_agent(
    [[-0.8, 0.5, 0.3], [0.4, -0.7, 0.3], [0.2, 0.3, -0.5]],
    [[1.0, 0.1], [0.2, 0.7], [0.0, 0.3]],
    np.eye(3),
    sector=(0.8, 1.2),
)
DIGRAPH = network_from_arcs(3, [(1, 2), (2, 3), (2, 1)], [1])
PATH = network_from_arcs(3, [(1, 2), (2, 1), (2, 3), (3, 2)], [1])


@pytest.mark.parametrize("network", [DIGRAPH, PATH], ids=["digraph", "undirected"])
@pytest.mark.parametrize("kind", ["diagonal", "symmetric"])
def test_gains_of_several_inputs_are_rounded_first_and_proved_as_they_are(
    network: Network, kind: str
) -> None:
    """Three digits, a coupling that is no power of two: K differs from -B'V/phi."""
    agent, phi = TWO_INPUTS, 3.0
    sector = (agent.m_l, agent.m_h)
    graph = (
        graph_scalar(network, sector)
        if kind == "diagonal"
        else quadratic.symmetric_scalar(network, sector)
    )
    if graph is None:
        assert network is DIGRAPH
        return
    found = lmi.feedback_gain(agent, network, phi, graph, 3, agent.A)
    assert found.proof.positive
    assert (nearest(found.K, 3) == found.K).all()
    off = np.abs(phi * found.K + agent.B.T * found.V).max()
    assert off > 1e-6
    rng = np.random.default_rng(3)
    M = network.pinned_laplacian.toarray()
    W = np.diag(graph.Theta) if kind == "diagonal" else M
    for _ in range(500):
        z = rng.normal(size=(3, 3))
        s = rng.choice(sector, (3, 2)) * (phi * M @ z @ found.K.T)
        dz = z @ agent.A.T + s @ agent.B.T
        value = np.sum(W * ((z * found.V) @ z.T))
        change = 2 * np.sum(W * ((z * found.V) @ dz.T))
        assert change <= -2 * found.kappa * value + 1e-9 * value


@pytest.mark.parametrize("network", [DIGRAPH, PATH], ids=["digraph", "undirected"])
def test_quadratic_function_of_the_sampled_loop_falls_in_every_period(network: Network) -> None:
    agent = attrs.evolve(EXAMPLE_1.agent("tanh"), lipschitz=0.2 if network is DIGRAPH else 0.02)
    h, ell = 0.001, float(np.max(agent.ell))
    graph = graph_scalar(network, (0.9, 1.2))
    if network is PATH:
        graph = quadratic.symmetric_scalar(network, (0.9, 1.2))
    assert graph is not None
    base = lmi.feedback_gain(agent, network, 10.0, graph, 6, agent.A)
    base = lmi.scaled_feedback(agent, 10.0, graph, base, 0.7, 6)
    loop = Loop(agent, network, base.K, np.zeros((2, 2)), phi=10.0, period=h)
    proof = sampled_feedback(loop, 10.0 * base.K, np.diag(base.V), graph, base.kappa)
    assert proof is not None
    assert proof.factor < 1
    rng = np.random.default_rng(0)
    M = network.pinned_laplacian.toarray()
    W = np.diag(graph.Theta) if graph.kind == "diagonal" else M
    worst = 0.0
    for _ in range(300):
        z = rng.normal(size=(3, 2)) if rng.random() < 0.5 else np.outer(network.p, [1.0, 1.0])
        s = rng.choice([0.9, 1.2], (3, 1)) * (10.0 * M @ z @ base.K.T)
        after = np.empty_like(z)
        for i in range(3):
            J = agent.A + agent.H @ np.diag(rng.choice([-ell, ell], 2))
            flow = expm(np.block([[J, np.eye(2)], [np.zeros((2, 4))]]) * h)
            after[i] = flow[:2, :2] @ z[i] + flow[:2, 2:] @ agent.B @ s[i]
        ratio = np.sum(W * (after @ proof.P @ after.T)) / np.sum(W * (z @ proof.P @ z.T))
        worst = max(worst, ratio)
        assert ratio <= proof.factor**2 * (1 + 1e-9)
    assert worst > 0.9


def test_a_refuted_condition_is_a_no_that_names_it() -> None:
    made = design(TWO_INPUTS, DIGRAPH, DesignSettings(method="lmi", phi=3.0), period=4.0)
    failing = made.certificate.failing
    assert made.certificate.certified == "no"
    assert {c.name for c in failing} == {
        "T: observer keeps signs for every tau <= h",
        "T: controller keeps signs for every tau <= h",
    }
    assert all(c.refuted for c in failing)


def test_a_graph_scalar_of_many_agents_is_proved_in_floating_point() -> None:
    n = 40
    arcs = [(i, i + 1) for i in range(1, n)] + [(i + 1, i) for i in range(1, n, 2)]
    network = network_from_arcs(n, arcs, [1, 9, 17, 25, 33])
    found = graph_scalar(network, (0.9, 1.1))
    assert "verified Cholesky" in found.proof.method
    M = network.pinned_laplacian.toarray()
    T = np.diag(found.Theta) @ M
    S = 1.0 * (T + T.T) - 0.01 * M.T @ np.diag(found.T) @ M - np.diag(found.Theta**2 / found.T)
    least = np.linalg.eigvalsh(S - found.value * np.diag(found.Theta))[0]
    assert 0 < found.proof.bound <= least
    above = found.value + 1.1 * least / found.Theta.min()
    proof = quadratic.graph_proof(network, (0.9, 1.1), above, found.Theta, found.T)
    assert not proof.positive
