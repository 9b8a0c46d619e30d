from __future__ import annotations

import numpy as np
import pytest

from posmas_fmi.design import DesignSettings, design, lmi
from posmas_fmi.design.paper_examples import EXAMPLE_1, EXAMPLE_2
from posmas_fmi.errors import DesignError


def kappa(example: object, pin: int) -> float:
    agent, network = example.agent(), example.network(pin)  # type: ignore[attr-defined]
    graph = lmi.graph_scalar(network, (agent.m_l, agent.m_h))
    # the reference figures leave |H|l out of the Metzler condition
    found = lmi.feedback_gain(agent, network, example.phi, graph.value, 6, agent.A)  # type: ignore[attr-defined]
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
    found = lmi.graph_scalar(network, (low, high))
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


def test_a_solver_that_does_not_finish_is_a_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    from posmas_fmi.design import solver

    monkeypatch.setattr(solver, "TIME_LIMIT", 1e-9)
    cp = solver.cvxpy()
    X = cp.Variable((20, 20), PSD=True)
    seed = np.random.default_rng(0).normal(size=(20, 20))
    program = cp.Problem(cp.Minimize(cp.trace(X)), [X >> seed @ seed.T])
    with pytest.raises(DesignError, match="not done after"):
        solver.solve(program, "feedback")
