from __future__ import annotations

import json
from pathlib import Path

import attrs
import numpy as np
import pytest
from scipy.linalg import expm

from posmas_fmi.agent import Agent, linear_agent
from posmas_fmi.certify import Loop
from posmas_fmi.certify.diverging import divergence
from posmas_fmi.cli import main
from posmas_fmi.cooling.line import LineParameters
from posmas_fmi.cooling.mapping import line_agent
from posmas_fmi.design import DesignSettings, certify, design
from posmas_fmi.design.graph_scalar import graph_scalar
from posmas_fmi.design.integral_gains import augmented, integral_design
from posmas_fmi.errors import DesignError, InputError
from posmas_fmi.network import Network, network_from_arcs
from posmas_fmi.scenario import load
from posmas_fmi.scenario.coverage import coverage
from posmas_fmi.scenario.job import make_design_of

# a cooling line: plate, return and supply temperatures; heat retained at the supply
LINE = linear_agent(
    [[-0.1996, 0.0998, 0.0998], [0.0435, -0.0945, 0.0509], [0.0, 0.0485, -0.0727]],
    [[0.0], [0.0], [0.01]],
    [[0.0, 0.0, 1.0]],
    sector=(0.5, 1.5),
)


def ring() -> Network:
    return network_from_arcs(5, [(1, 2), (2, 3), (3, 4), (4, 5), (5, 1), (1, 4)], [1])


def test_offset_of_unequal_loads_vanishes_for_switching_slopes() -> None:
    network = ring()
    graph = graph_scalar(network, LINE.sector)
    made = integral_design(LINE, graph, LINE.C, rate=0.002)
    rng = np.random.default_rng(1)
    M = network.pinned_laplacian.toarray()
    A, B, _ = augmented(LINE, LINE.C)
    gain = np.hstack([made.K, made.K_q])
    # incremental form: z = (δ, w), w_i' = C_z δ_i; slopes fixed per agent, constant loads
    slopes = rng.uniform(0.5, 1.5, 5)
    J = np.kron(np.eye(5), A) + np.kron(np.diag(slopes) @ M, B @ gain)
    assert np.linalg.eigvals(J).real.max() <= -made.kappa + 1e-9
    load = np.zeros((5, 4))
    load[:, 0] = rng.uniform(0.0, 0.2, 5)
    steady = np.linalg.solve(-J, load.ravel()).reshape(5, 4)
    assert np.abs(steady[:, 2]).max() < 1e-9  # what is integrated has no offset
    assert np.abs(steady[:, 0]).max() > 0.1  # the rest carries the load


def test_quadratic_function_falls_for_every_time_varying_slope() -> None:
    network = ring()
    graph = graph_scalar(network, LINE.sector)
    made = integral_design(LINE, graph, LINE.C, rate=0.002)
    rng = np.random.default_rng(2)
    M = network.pinned_laplacian.toarray()
    A, B, _ = augmented(LINE, LINE.C)
    gain, theta = np.hstack([made.K, made.K_q]), made.graph.Theta
    for _ in range(500):
        z = rng.normal(size=(5, 4))
        slopes = rng.choice([0.5, 1.5], (5, 1))
        dz = z @ A.T + (slopes * (M @ z @ gain.T)) @ B.T
        value = float(theta @ np.einsum("ni,ij,nj->n", z, made.V, z))
        change = 2 * float(theta @ np.einsum("ni,ij,nj->n", z, made.V, dz))
        assert change <= -2 * made.kappa * value + 1e-9 * value


def test_a_rate_out_of_reach_is_a_clear_error() -> None:
    graph = graph_scalar(ring(), LINE.sector)
    with pytest.raises(DesignError, match="rate"):
        integral_design(LINE, graph, np.array([[0.0, 0.0, 0.0]]), rate=0.01)
    with pytest.raises(DesignError, match="what helps: a lower rate"):
        design(LINE, ring(), DesignSettings(method="integral", rate=50.0), None)


def test_wrong_shape_of_what_is_integrated() -> None:
    with pytest.raises(DesignError, match="3 columns"):
        integral_design(LINE, graph_scalar(ring(), LINE.sector), np.eye(2), rate=0.01)


# ---- rows of cooling lines -----------------------------------------------------------------------


def cooling() -> Agent:
    """Lines whose leakage does not depend on the temperature, valves from 40 % on."""
    line = attrs.evolve(LineParameters(), kl=0.0)
    agent = line_agent(line, theta_r=(10.0, 22.0), opening=(0.4, 1.0))
    assert agent.slope is not None
    return attrs.evolve(agent, sector=agent.slope)


def rows_of_lines(count: int, row: int = 10) -> Network:
    """Undirected rings, every fifth line pinned."""
    arcs = []
    for first in range(0, count, row):
        for k in range(row):
            i, j = first + k + 1, first + (k + 1) % row + 1
            arcs += [(i, j), (j, i)]
    return network_from_arcs(count, arcs, list(range(1, count + 1, 5)))


def test_a_thousand_cooling_lines_are_proved_with_small_programs() -> None:
    agent, settings = cooling(), DesignSettings(method="integral")
    few, many = (design(agent, rows_of_lines(n), settings, 5.0) for n in (10, 1000))
    for made in (few, many):
        assert made.integrates == ("y2",)
        assert made.K_q is not None
        assert (made.K_q < 0).all()
        assert made.certificate.failing == ()
        assert made.certificate.certified == "yes"
        slope = next(a for a in made.certificate.assumptions if a.name == "slope")
        assert "closed form" in slope.detail
        names = [c.name for c in made.certificate.conditions]
        assert "I: sampled loop contracts" in names
        assert made.certificate.rate is not None
        assert not made.certificate.positive
        assert made.to_dict()["K_q"] == made.K_q.tolist()
    # the certificate does not know how many rows there are
    assert many.certificate.rate == few.certificate.rate


def test_sampled_cooling_lines_with_their_gains_contract_and_leave_no_offset() -> None:
    """Linear loops inside the claim, with slopes that differ from line to line."""
    agent, network, h = cooling(), rows_of_lines(10), 5.0
    made = design(agent, network, DesignSettings(method="integral"), h)
    assert made.K_q is not None
    assert made.certificate.rate is not None
    M = network.pinned_laplacian.toarray()
    flow = expm(np.block([[agent.A, np.eye(3)], [np.zeros((3, 6))]]) * h)
    Phi, Gamma = flow[:3, :3], flow[:3, 3:]
    rng = np.random.default_rng(0)
    for slopes in (np.full(10, agent.m_l), np.full(10, agent.m_h), rng.choice(agent.sector, 10)):
        # w integrates theta_s; u = M (K delta + K_q w)
        T = np.kron(np.eye(10), np.block([[Phi, np.zeros((3, 1))], [h * agent.C[1:], np.eye(1)]]))
        push = np.vstack([Gamma @ agent.B, [[0.0]]])
        T += np.kron(slopes[:, None] * M, push @ np.hstack([made.K, made.K_q]))
        radius = np.abs(np.linalg.eigvals(T)).max()
        assert radius <= np.exp(-made.certificate.rate * h) * (1 + 1e-9)
        load = np.zeros((10, 4))
        load[:, :3] = rng.random((10, 3)) @ Gamma.T
        steady = np.linalg.solve(np.eye(40) - T, load.ravel()).reshape(10, 4)
        assert np.abs(steady[:, 2]).max() < 1e-8 * np.abs(steady[:, 0]).max()


def test_given_integral_gains_are_certified_and_bad_ones_are_not() -> None:
    agent, network, settings = cooling(), rows_of_lines(10), DesignSettings()
    made = design(agent, network, attrs.evolve(settings, method="integral"), 5.0)
    assert made.K_q is not None
    again = certify(agent, network, made.K, made.E, settings, 5.0, made.K_q)
    assert again.certificate.rate == pytest.approx(made.certificate.rate)
    assert [c.holds for c in again.certificate.conditions] == [True] * 4
    worse = certify(agent, network, made.K, made.E, settings, 5.0, -made.K_q)
    assert worse.certificate.certified == "no"
    with pytest.raises(InputError, match="one column per integrated output"):
        certify(agent, network, made.K, made.E, settings, 5.0, np.ones((1, 2)))
    for bad in (("y3",), ("y1", "y2")):
        with pytest.raises(InputError, match="integrates"):
            design(agent, network, DesignSettings(method="integral", integrates=bad), 5.0)


TANK = linear_agent([[-0.1]], [[1.0]], [[1.0]], sector=(0.8, 1.2))
PAIR = network_from_arcs(2, [(1, 2), (2, 1)], [1])


@pytest.mark.parametrize(
    ("K_q", "certified", "refuted"),
    [(-0.001, "yes", False), (-0.3, "no", False), (-2.5, "no", True), (0.01, "no", True)],
)
def test_what_is_refuted_is_told_from_what_is_only_not_proved(
    K_q: float, certified: str, refuted: bool
) -> None:
    made = certify(TANK, PAIR, [[-0.3]], [[1.0]], DesignSettings(), 0.5, [[K_q]])  # type: ignore[arg-type]
    assert (made.certificate.certified, made.certificate.refuted) == (certified, refuted)
    if refuted:
        (failed,) = made.certificate.failing
        assert "does not converge" in failed.proof
        A, held = np.exp(-0.05), (1 - np.exp(-0.05)) / 0.1
        M = PAIR.pinned_laplacian.toarray()
        T = np.kron(np.eye(2), [[A, 0.0], [0.5, 1.0]])
        T += 1.2 * np.kron(M, np.outer([held, 0.0], [-0.3, K_q]))
        assert np.abs(np.linalg.eigvals(T)).max() >= 1 - failed.margin > 1
    elif certified == "no":
        assert [c.proof for c in made.certificate.failing] == [
            "the search found no quadratic function"
        ]


def test_a_design_that_is_only_good_in_continuous_time_is_not_taken() -> None:
    """At a period of 2 s the gains for the fastest rates make the sampled loop diverge."""
    made = design(TANK, PAIR, DesignSettings(method="integral"), 2.0)
    assert made.K_q is not None
    loop = Loop(TANK, PAIR, made.K, made.E, period=2.0)
    assert divergence(loop, np.hstack([made.K, made.K_q]), np.eye(1)) is None
    fast = integral_design(TANK, graph_scalar(PAIR, TANK.sector), np.eye(1), rate=0.5)
    found = divergence(loop, np.hstack([fast.K, fast.K_q]), np.eye(1))
    assert found is not None
    assert found.factor > 1


TANKS = """
[scenario]
name = "tanks"
until = 10.0
period = 0.5
[agent]
A = [[-0.1]]
B = [[1.0]]
C = [[1.0]]
g = ["0"]
sec = ["u1"]
sector = [0.8, 1.2]
[network]
agents = 2
arcs = [[1, 2], [2, 1]]
pinned = [1]
[design]
method = "integral"
integrates = ["y1"]
[leader]
s0 = [1.0]
"""


def test_delays_are_not_covered_by_the_integral_certificate(tmp_path: Path) -> None:
    path = tmp_path / "late.toml"
    path.write_text(TANKS + "[channel]\ndelay = 0.5\n", encoding="utf-8")
    scenario = load(path)
    made = make_design_of(scenario)
    assert made.certificate.certified == "yes"
    assert any(text.startswith("not covered: delays") for text in made.certificate.covers)
    (row,) = coverage(scenario, made)
    assert (row["what"], row["covered"]) == ("delay of messages", False)
    assert "certificate D is not proved" in row["why"]


def test_the_integral_design_is_chosen_in_a_scenario(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "tanks.toml"
    path.write_text(TANKS, encoding="utf-8")
    assert main(["design", str(path), "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["certified"] == "yes"
    assert made["K_q"][0][0] < 0
    gains = tmp_path / "design.json"
    gains.write_text(json.dumps(made), encoding="utf-8")
    assert main(["certify", str(path), "--gains", str(gains), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rate"] == pytest.approx(made["rate"])
    assert main(["design", str(path)]) == 0
    assert "K_q" in capsys.readouterr().out
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "without integrals" in capsys.readouterr().err
