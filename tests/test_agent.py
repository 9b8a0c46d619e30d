import numpy as np
import paper
import pytest

from posmas_fmi.agent import Agent, is_metzler, linear_agent, state_names
from posmas_fmi.errors import AgentError
from posmas_fmi.expression import VectorFunction


def status(agent):
    return {a.name: a.status for a in agent.assumptions()}


def test_example_1_has_its_sector_but_not_its_lipschitz_bound():
    """Erratum 9: beta = 1 is false, the growth bound is true."""
    agent = paper.agent(1)
    assert status(agent) == {
        "sector": "verified",
        "lipschitz": "contradicted",
        "growth": "verified",
    }
    np.testing.assert_allclose(agent.growth, 1.0)
    t, x = 8.435, 3.683
    psi = 0.31 * x * t
    assert abs(np.sin(psi) + psi * np.cos(psi)) > 9


def test_tanh_has_the_bound_that_the_paper_claims():
    assert set(status(paper.agent(1, paper.TANH)).values()) == {"verified"}


@pytest.mark.parametrize(
    ("sec", "sector", "expected"),
    [
        ("u1", (1.0, 1.0), "verified"),
        ("tanh(u1)", (0.0, 1.0), "verified"),
        ("tanh(u1)", (0.1, 1.0), "contradicted"),
        ("clip(u1, -2, 2)", (0.0, 1.0), "verified"),
        ("clip(u1, -2, 2)", (0.0, 0.9), "contradicted"),
        ("0.5*u1 + 0.2*sin(u1)", (0.4, 0.7), "verified"),
        ("u1 + 1", (0.5, 2.0), "contradicted"),
        ("u1**3", (0.0, 1.0), "contradicted"),
    ],
)
def test_sector_is_proved_or_refuted(sec, sector, expected):
    agent = Agent(
        A=[[-1.0]],
        H=[[0.0]],
        B=[[1.0]],
        C=[[1.0]],
        g=VectorFunction.parse(["0"], state_names(1)),
        sec=VectorFunction.parse([sec], ["u1"]),
        sector=sector,
    )
    assert status(agent)["sector"] == expected


def test_sector_over_a_bounded_input():
    agent = Agent(
        A=[[-1.0]],
        H=[[0.0]],
        B=[[1.0]],
        C=[[1.0]],
        g=VectorFunction.parse(["0"], state_names(1)),
        sec=VectorFunction.parse(["clip(u1, -1, 1)"], ["u1"]),
        sector=(0.5, 1.0),
        region={"u1": (-2.0, 2.0)},
    )
    assert status(agent)["sector"] == "verified"


def test_without_a_declared_bound_it_is_computed():
    agent = Agent(
        **paper.MATRICES[1],
        g=VectorFunction.parse(["0.5*sin(x1)", "x1*x2"], state_names(2)),
        sec=VectorFunction.parse(["u1"], ["u1"]),
        region={"x1": (0.0, 2.0), "x2": (0.0, 3.0)},
    )
    np.testing.assert_allclose(agent.ell, [[0.5, 0.0], [3.0, 2.0]], rtol=2e-3)
    assert status(agent)["lipschitz"] == "verified"
    # |H| ell is the product with the bounds of each g_k
    np.testing.assert_allclose(agent.H_ell, np.abs(agent.H) @ agent.ell)


def test_callables_are_accepted_and_nothing_is_claimed_about_them():
    agent = Agent(
        A=[[-1.0]],
        H=[[1.0]],
        B=[[1.0]],
        C=[[1.0]],
        g=lambda t, X: np.sin(X),
        sec=lambda U: U,
        lipschitz=1.0,
    )
    assert set(status(agent).values()) == {"declared"}
    np.testing.assert_allclose(
        agent.derivative(0.0, np.array([[0.0], [1.0]]), np.array([[1.0], [0.0]])),
        [[1.0], [np.sin(1) - 1]],
    )


@pytest.mark.parametrize(
    ("change", "place", "word"),
    [
        ({"A": [[-1.0, -0.1], [1.0, -1.0]]}, "$.agent.A[0][1]", "Metzler"),
        ({"A": [[-1.0, 1.0]]}, "$.agent.A", "(1, 2)"),
        ({"B": [[-0.1], [1.0]]}, "$.agent.B[0][0]", "non-negative"),
        ({"B": [[1.0]]}, "$.agent.B", "one row per state with m = 2"),
        ({"C": [[1.0]]}, "$.agent.C", "one column per state with m = 2"),
        ({"H": [[np.nan, 0.0], [0.0, 0.0]]}, "$.agent.H[0][0]", "nan"),
        ({"sector": (0.5, 0.2)}, "$.agent.sector", "m_l"),
        ({"lipschitz": [1.0, 2.0, 3.0]}, "$.agent.lipschitz", "one per state"),
        ({"lipschitz": -1.0}, "$.agent.lipschitz", "-1.0"),
        ({"g": VectorFunction.parse(["0"], state_names(2))}, "$.agent.g", "2 expression"),
        ({"sec": "u1"}, "$.agent.sec", "callable"),
    ],
)
def test_what_is_no_positive_agent_is_refused_by_name(change, place, word):
    good = paper.MATRICES[1] | {
        "g": VectorFunction.parse(paper.G, state_names(2)),
        "sec": VectorFunction.parse(paper.SEC, ["u1"]),
    }
    with pytest.raises(AgentError) as caught:
        Agent(**good | change)
    assert caught.value.where == place
    assert word in caught.value.message


def test_all_mistakes_of_an_agent_are_found_together():
    with pytest.raises(AgentError) as caught:
        Agent(
            A=[[-1.0, -2.0], [1.0, -1.0]],
            H=[[0.0]],
            B=[[1.0], [-1.0]],
            C=[[1.0]],
            g=VectorFunction.parse(["0"], state_names(2)),
            sec=VectorFunction.parse(["u1"], ["u1"]),
            sector=(2.0, 1.0),
        )
    assert {place for place, _ in caught.value.problems} == {
        "$.agent.A[0][1]", "$.agent.H", "$.agent.B[1][0]", "$.agent.C", "$.agent.g",
        "$.agent.sector",
    }  # fmt: skip


@pytest.mark.parametrize("wrong", [3.0, [1.0, 2.0], [[[1.0]]], []])
@pytest.mark.parametrize("name", ["A", "B", "C", "H"])
def test_what_is_no_matrix_is_named(name, wrong):
    functions = {
        "g": VectorFunction.parse(paper.G, state_names(2)),
        "sec": VectorFunction.parse(paper.SEC, ["u1"]),
    }
    with pytest.raises(AgentError) as caught:
        Agent(**paper.MATRICES[1] | {name: wrong} | functions)
    assert f"$.agent.{name}" in {place for place, _ in caught.value.problems}


def test_sec_must_be_elementwise():
    with pytest.raises(AgentError, match="elementwise"):
        Agent(
            A=[[-1.0]],
            H=[[0.0]],
            B=[[1.0, 1.0]],
            C=[[1.0]],
            g=VectorFunction.parse(["0"], state_names(1)),
            sec=VectorFunction.parse(["u1 + u2", "u2"], ["u1", "u2"]),
        )


def test_python_control_sees_the_agent():
    control = pytest.importorskip("control")
    agent = paper.agent(1)
    assert isinstance(agent.to_statespace(), control.StateSpace)
    assert agent.controllable
    assert agent.observable
    assert not agent.hurwitz  # erratum 3: an eigenvalue at +0.1302
    assert max(agent.to_statespace().poles().real) == pytest.approx(0.1302, abs=5e-5)
    linear = control.linearize(agent.to_iosystem(), [0.0, 0.0], [0.0])
    # at x = 0: g1' = 0 and g2' = cos 0 = 1; sec'(0) = 1.2
    np.testing.assert_allclose(linear.A, agent.A + agent.H @ np.diag([0.0, 1.0]), atol=1e-4)
    np.testing.assert_allclose(linear.B, 1.2 * agent.B, atol=1e-4)


def test_uncontrollable_pair_is_seen():
    agent = linear_agent([[-1.0, 0.0], [0.0, -1.0]], [[1.0], [1.0]], [[1.0, 0.0]])
    assert not agent.controllable
    assert not agent.observable
    assert agent.hurwitz


def test_metzler():
    assert is_metzler([[-1, 2], [0, -3]])
    assert not is_metzler([[1, -1e-12], [0, 1]])
