from __future__ import annotations

import numpy as np
import pytest

from posmas_fmi.design import DesignSettings, design
from posmas_fmi.design.paper import active, algorithm, gammas
from posmas_fmi.design.paper_examples import EXAMPLE_1, EXAMPLE_2, Example
from posmas_fmi.design.settings import Reading
from posmas_fmi.errors import DesignError, InputError


def settings(example: Example, **changes: object) -> DesignSettings:
    return DesignSettings(phi=example.phi, mu=example.mu, **changes)


def test_hull_keeps_the_largest_eigenvalue() -> None:
    rng = np.random.default_rng(0)
    B = np.array([[0.7], [0.7]])
    M = np.array([[1.0, 0.3], [0.3, -2.0]])
    for _ in range(50):
        gamma, inverse = rng.uniform(0, 9, 40), rng.uniform(1, 30, 40)

        def top(i: int, gamma: np.ndarray = gamma, inverse: np.ndarray = inverse) -> float:
            return float(
                np.linalg.eigvalsh(M - gamma[i] * B @ B.T - 0.02 * inverse[i] * np.eye(2))[-1]
            )

        kept = active(gamma, inverse)
        assert max(top(i) for i in range(40)) == pytest.approx(max(top(int(i)) for i in kept))
        assert len(kept) < 20


def test_reduced_algorithm_has_the_same_optimum_as_all_lmis() -> None:
    example = EXAMPLE_2
    agent, network = example.agent(), example.network(1)
    reduced = algorithm(agent, network, 1, settings(example))
    gamma, f = gammas(network, agent.sector, example.phi, example.eta, Reading())
    full = algorithm(agent, network, 1, settings(example))
    full = type(full)(
        agent,
        tuple((float(g), float(1 / x), 1.0) for g, x in zip(gamma, f, strict=True)),
        full.strong,
        full.feedback,
        full.delta,
    )
    Pi = np.full(2, 0.85)
    assert len(reduced.points) < len(full.points)
    first, second = (a.minimise(Pi, None, True)[0] for a in (reduced, full))
    assert first == pytest.approx(second, abs=1e-6)


def test_no_reading_of_gamma_gives_the_printed_alpha() -> None:
    example = EXAMPLE_1
    for pin in (1, 2, 3, 4):
        for coupling in ("L - D", "L + D"):
            for order in ("ascending", "descending", "rigorous"):
                reading = Reading(coupling=coupling, order=order)
                found = algorithm(
                    example.agent(), example.network(pin), 1, settings(example), reading
                )
                alpha, _, _ = found.minimise(np.full(2, 0.5), None, False)
                assert alpha > example.designs[1].alpha + 5.0


def test_algorithm_2_of_example_1_is_infeasible_with_its_reason() -> None:
    with pytest.raises(DesignError, match="erratum 3"):
        design(
            EXAMPLE_1.agent(),
            EXAMPLE_1.network(2),
            settings(EXAMPLE_1, method="paper-2", form="printed"),
            0.005,
        )


def test_best_alpha_of_algorithm_2_is_positive() -> None:
    found = algorithm(EXAMPLE_1.agent(), EXAMPLE_1.network(1), 2, settings(EXAMPLE_1))
    alpha, _, _ = found.minimise(np.full(2, 0.5), None, True)
    assert alpha == pytest.approx(0.13, abs=0.01)


@pytest.mark.parametrize("method", ["paper-1", "paper-2"])
def test_corrected_forms_are_certified(method: str) -> None:
    made = design(
        EXAMPLE_1.agent("tanh"), EXAMPLE_1.network(2), settings(EXAMPLE_1, method=method), 0.005
    )
    assert not made.certificate.failing
    assert made.certificate.positive
    assert made.observer == ("local" if method == "paper-1" else "distributed")


def test_printed_algorithm_1_of_example_2_is_not_positive() -> None:
    made = design(
        EXAMPLE_2.agent(),
        EXAMPLE_2.network(1),
        settings(EXAMPLE_2, method="paper-1", form="printed"),
        0.005,
    )
    assert made.certificate.certified == "no"
    assert not made.certificate.positive
    assert made.notes


def test_joint_form_is_where_the_alternation_has_not_arrived_after_six_rounds() -> None:
    reading = Reading(coupling="L + D", order="rigorous")
    found = algorithm(EXAMPLE_1.agent(), EXAMPLE_1.network(2), 1, settings(EXAMPLE_1), reading)
    Pi, alpha = np.full(2, 2.0), np.inf
    for _ in range(6):
        alpha, E, _ = found.minimise(Pi, None, False)
        _, _, Pi = found.minimise(None, E, False)
    joint = found.joint(symmetric=False)
    assert alpha == pytest.approx(-6.554, abs=1e-3)
    assert joint.alpha == pytest.approx(-6.780, abs=1e-3)
    # its α is that of its own E and Π, and step 3 at that Π gains nothing
    assert found.minimise(joint.Pi, None, False)[0] == pytest.approx(joint.alpha, abs=1e-6)


@pytest.mark.parametrize("symmetric", [False, True])
def test_joint_form_satisfies_the_printed_conditions(symmetric: bool) -> None:
    found = algorithm(EXAMPLE_1.agent(), EXAMPLE_1.network(2), 1, settings(EXAMPLE_1))
    joint = found.joint(symmetric)
    agent, P = found.agent, np.diag(joint.Pi)
    EC, BB = joint.E @ agent.C, agent.B @ agent.B.T
    off = ~np.eye(2, dtype=bool)
    assert EC.min() >= -1e-6
    assert (agent.A - EC)[off].min() >= -1e-6
    assert (agent.A - found.feedback * BB @ np.linalg.inv(P))[off].min() >= -1e-4
    assert np.allclose(joint.E, joint.E.T, atol=1e-9) == symmetric
    for gamma, inverse_f, c in found.points:
        top = (agent.A + agent.H) @ P + P @ (agent.A + agent.H).T - gamma * BB
        top = top - found.delta * inverse_f * P @ P
        side, low = (c * EC + agent.H) @ P, (agent.A - c * EC) @ P
        block = np.block([[top, side], [side.T, low + low.T]])
        assert np.linalg.eigvalsh(block)[-1] <= joint.alpha + 1e-6


def test_joint_form_can_be_chosen() -> None:
    example = EXAMPLE_1
    chosen = settings(example, method="paper-1", form="joint")
    made = design(example.agent("tanh"), example.network(2), chosen, 0.005)
    assert made.form == "joint"
    assert "joint" in made.notes[0]


def test_a_reading_of_the_text_is_chosen_in_a_scenario() -> None:
    """Only a symmetric E is printed; any E does at least as well."""
    alphas = []
    for symmetric in (True, False):
        reading = {"coupling": "L + D", "order": "rigorous", "s": 0.5, "symmetric_E": symmetric}
        chosen = settings(EXAMPLE_1, method="paper-1", form="printed", reading=reading)
        made = design(EXAMPLE_1.agent(), EXAMPLE_1.network(1), chosen, 0.005)
        kind = "symmetric" if symmetric else "free"
        assert f"a(L + D), s = 0.5, eigenvalues rigorous, E {kind}" in made.notes[0]
        assert bool(made.E[0, 1] == made.E[1, 0]) is symmetric
        alphas.append(float(made.notes[0].partition("alpha = ")[2].partition(",")[0]))
    assert alphas[1] <= alphas[0] + 1e-6


@pytest.mark.parametrize(
    ("reading", "place"),
    [
        ({"order": "random"}, "$.design.reading.order"),
        ({"s": -1.0}, "$.design.reading.s"),
        ({"sigma": 1.0}, "$.design.reading"),
        ("L - D", "$.design.reading"),
    ],
)
def test_readings_that_there_are_not_are_refused(reading: object, place: str) -> None:
    with pytest.raises(InputError) as caught:
        settings(EXAMPLE_1, reading=reading)
    assert caught.value.where == place
