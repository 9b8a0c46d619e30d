from __future__ import annotations

import json
import re

import attrs
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from posmas_fmi.agent import linear_agent
from posmas_fmi.design import DesignSettings, certify, design
from posmas_fmi.design.paper_examples import EXAMPLE_1, EXAMPLE_2
from posmas_fmi.errors import AgentError, DesignError, InputError, NetworkError
from posmas_fmi.network import network_from_arcs

SETTINGS_1 = DesignSettings(phi=10.0)


@pytest.mark.parametrize(
    ("period", "rate"), [(0.001, 0.320), (0.005, 0.254), (0.01, 0.176), (0.02, 0.034)]
)
@pytest.mark.parametrize("pin", [2, 4])
def test_reference_figures_of_sampled_designs(period: float, rate: float, pin: int) -> None:
    made = design(EXAMPLE_1.agent(), EXAMPLE_1.network(pin), SETTINGS_1, period)
    certificate = made.certificate
    assert certificate.rate == pytest.approx(rate, abs=6e-4)
    assert certificate.certified == "conditional"
    assert certificate.positive
    assert certificate.p_max == pytest.approx(5.0)
    assert certificate.rate_perron is not None
    assert certificate.rate_perron > rate


def test_reference_figures_in_continuous_time() -> None:
    made = design(EXAMPLE_1.agent(), EXAMPLE_1.network(2), SETTINGS_1)
    assert pytest.approx(np.array([[-0.5725, -0.5786]]), abs=1e-4) == made.K
    assert made.certificate.rate_continuous == pytest.approx(0.665, abs=1e-3)
    second = design(EXAMPLE_2.agent(), EXAMPLE_2.network(1), DesignSettings(phi=30.0))
    assert pytest.approx(np.array([[-0.0726, -0.0709]]), abs=1e-4) == second.K
    assert second.certificate.rate_continuous == pytest.approx(2.19, abs=5e-3)
    assert second.certificate.p_max == pytest.approx(19.0)
    assert second.baseline.contracts
    assert not made.baseline.contracts


def test_no_design_at_50_ms_says_what_helps() -> None:
    with pytest.raises(DesignError) as caught:
        design(EXAMPLE_1.agent(), EXAMPLE_1.network(2), SETTINGS_1, 0.05)
    text = str(caught.value)
    assert "positivity and contraction of the controller clash" in text
    assert "a period of 0.025 s" in text
    assert "agent 1" in text


@pytest.mark.parametrize("pin", [1, 3])
@pytest.mark.parametrize("period", [None, 0.005])
def test_pins_without_certificate_name_one_that_has_it(pin: int, period: float | None) -> None:
    with pytest.raises(DesignError, match=r"pinning agent [24] instead"):
        design(EXAMPLE_1.agent(), EXAMPLE_1.network(pin), SETTINGS_1, period)


def test_observer_is_ten_times_as_fast_unless_told() -> None:
    made = design(EXAMPLE_1.agent(), EXAMPLE_1.network(2), SETTINGS_1, 0.005)
    assert made.certificate.rate_perron is not None
    assert made.certificate.observer_rate == pytest.approx(
        10 * made.certificate.rate_perron, rel=1e-3
    )
    slower = DesignSettings(phi=10.0, observer_rate=2.0)
    told = design(EXAMPLE_1.agent(), EXAMPLE_1.network(2), slower, 0.005)
    assert told.certificate.observer_rate == pytest.approx(2.0, rel=1e-3)
    assert np.abs(told.E).sum() < np.abs(made.E).sum()


def test_an_observer_rate_out_of_reach_is_refused() -> None:
    with pytest.raises(DesignError, match="observer"):
        design(
            EXAMPLE_1.agent(),
            EXAMPLE_1.network(2),
            DesignSettings(phi=10.0, observer_rate=1e4),
            0.005,
        )


def test_least_gain_for_a_wanted_rate() -> None:
    wanted = DesignSettings(phi=10.0, objective="gain", rate=0.2, weights="perron")
    made = design(EXAMPLE_1.agent(), EXAMPLE_1.network(2), wanted, 0.005)
    fastest = design(EXAMPLE_1.agent(), EXAMPLE_1.network(2), SETTINGS_1, 0.005)
    assert made.certificate.rate == pytest.approx(0.2, rel=1e-3)
    assert made.certificate.rate >= 0.2 * (1 - 1e-6)
    assert np.abs(made.K).sum() < np.abs(fastest.K).sum()


def test_distributed_observer_is_conditional_on_the_innovation() -> None:
    chosen = DesignSettings(phi=10.0, mu=15.0, observer="distributed")
    made = design(EXAMPLE_1.agent("tanh"), EXAMPLE_1.network(2), chosen, 0.005)
    assert made.certificate.certified == "conditional"
    assert [a.name for a in made.certificate.open_assumptions] == ["innovation"]


def test_phi_scales_out() -> None:
    one = design(EXAMPLE_1.agent(), EXAMPLE_1.network(2), DesignSettings(phi=1.0), 0.005)
    ten = design(EXAMPLE_1.agent(), EXAMPLE_1.network(2), SETTINGS_1, 0.005)
    assert pytest.approx(10 * ten.K, rel=1e-4) == one.K


def test_certify_returns_no_and_does_not_raise() -> None:
    made = certify(
        EXAMPLE_1.agent(),
        EXAMPLE_1.network(2),
        np.array([[-5.0, -5.0]]),
        np.zeros((2, 2)),
        SETTINGS_1,
        0.005,
    )
    assert made.certificate.certified == "no"
    assert made.method == "gains"


def test_certify_refuses_wrong_shapes() -> None:
    with pytest.raises(InputError, match=r"shape \(1, 2\)"):
        certify(
            EXAMPLE_1.agent(), EXAMPLE_1.network(2), [[1.0]], np.zeros((2, 2)), SETTINGS_1, 0.005
        )


def test_json_form_has_the_keys_of_the_contract_and_no_nan() -> None:
    made = design(EXAMPLE_1.agent(), EXAMPLE_1.network(2), SETTINGS_1, 0.005)
    data = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    contract = {
        "method", "K", "E", "certified", "assumptions", "rate", "observer_rate", "positive",
        "pinned", "p_max", "period", "conditions",
    }  # fmt: skip
    assert contract <= set(data)
    assert {"name", "holds", "margin", "proof"} <= set(data["conditions"][0])
    assert {"name", "status", "detail"} <= set(data["assumptions"][0])
    assert data["pinned"] == ["2"]


def test_printed_protocol_keeps_its_gains_but_no_certificate() -> None:
    made = design(
        EXAMPLE_1.agent(), EXAMPLE_1.network(2), DesignSettings(phi=10.0, protocol="printed"), 0.005
    )
    assert made.certificate.certified == "no"
    assert made.protocol == "printed"


def test_unreachable_agent() -> None:
    network = network_from_arcs(3, [(1, 2)], pinned=[1])
    with pytest.raises(NetworkError, match="agent\\(s\\) 3"):
        design(linear_agent([[-1.0]], [[1.0]], [[1.0]]), network, DesignSettings(), 0.1)


def test_no_actuation_of_an_unstable_agent() -> None:
    agent = linear_agent([[0.5]], [[1.0]], [[1.0]], sector=(0.0, 1.0))
    with pytest.raises(DesignError, match="no gain contracts even without positivity"):
        design(agent, network_from_arcs(1, [], [1]), DesignSettings(), 0.1)


def test_huge_entries_do_not_crash() -> None:
    agent = linear_agent([[-1e300]], [[1.0]], [[1.0]])
    network = network_from_arcs(1, [], [1])
    with pytest.raises(AgentError, match=r"\$\.agent\.A\[0\]\[0\].*1e\+300"):
        design(agent, network, DesignSettings(), 0.1)
    made = certify(agent, network, [[-1.0]], [[1.0]], DesignSettings(), 0.1)
    assert made.certificate.certified == "no"
    json.dumps(made.to_dict(), allow_nan=False)


@settings(deadline=None, max_examples=12)
@given(st.integers(0, 10**6))
def test_designed_gains_are_always_certified(seed: int) -> None:
    rng = np.random.default_rng(seed)
    m = int(rng.integers(1, 4))
    A = rng.uniform(0.0, 3.0, (m, m))
    A -= np.diag(A.sum(axis=1) + rng.uniform(-0.05, 1.0))
    B, C = rng.uniform(0.1, 1.0, (m, 1)), np.eye(m)
    agent = linear_agent(A, B, C, sector=(0.8, 1.1))
    n = int(rng.integers(1, 6))
    arcs = [(int(rng.integers(1, k + 1)), k + 1) for k in range(1, n)]
    network = network_from_arcs(n, arcs, [1])
    try:
        made = design(agent, network, DesignSettings(), 0.01)
    except DesignError as error:
        assume("clash" not in str(error))
        raise
    assert made.certificate.certified == "yes"
    # the exact worst linear loop cannot be slower than what is proved
    L_p = network.pinned_laplacian.toarray()
    from scipy.linalg import expm

    W = expm(np.block([[A, np.eye(m)], [np.zeros((m, 2 * m))]]) * 0.01)
    step = np.kron(np.eye(n), W[:m, :m]) + 0.8 * np.kron(L_p, W[:m, m:] @ B @ made.K)
    radius = np.abs(np.linalg.eigvals(step)).max()
    assert made.certificate.rate is not None
    assert np.exp(-made.certificate.rate * 0.01) >= radius - 1e-9


def test_a_failed_certificate_says_what_would_help() -> None:
    K, E = [[-0.541353, -0.548052]], EXAMPLE_1.designs[1].E
    made = certify(EXAMPLE_1.agent(), EXAMPLE_1.network(2), K, E, SETTINGS_1, 0.02)
    assert made.certificate.certified == "no"
    text = "; ".join(made.notes)
    assert "a period of 0.004 s is certified" in text
    assert "phi = 8" in text
    wrong_pin = certify(EXAMPLE_1.agent(), EXAMPLE_1.network(1), K, E, SETTINGS_1, 0.005)
    assert any("pinning agent 2" in note for note in wrong_pin.notes)


@pytest.mark.parametrize("period", [None, 5.0])
def test_states_that_no_input_reaches_directly(period: float | None) -> None:
    """A line with one input and zeros in A: the gain is used where it helps, and proved."""
    A = [[-0.1996, 0.0998, 0.0998], [0.0435, -0.0945, 0.0509], [0.0, 0.0243, -0.0727]]
    line = linear_agent(A, [[0.0], [0.0], [0.01]], np.eye(3), sector=(0.8, 1.2))
    network = network_from_arcs(3, [(1, 2), (2, 3), (3, 1)], [1])
    made = design(line, network, DesignSettings(), period)
    assert made.certificate.certified == "yes"
    assert made.K[0, 0] == 0.0  # A_31 = 0 leaves no room there
    assert made.K[0, 2] < 0
    assert made.certificate.rate is not None
    assert made.baseline.rate is not None
    assert made.certificate.rate > made.baseline.rate * 1.01


@pytest.mark.parametrize("observer", ["local", "distributed"])
@pytest.mark.parametrize("period", [0.005, None])
def test_objectives_do_what_they_say(observer: str, period: float | None) -> None:
    agent, network = EXAMPLE_1.agent("tanh"), EXAMPLE_1.network(2)
    common = {"phi": 10.0, "mu": 15.0, "observer": observer, "disturbance": (0.05, 1.0)}
    fast, small, narrow = (
        design(agent, network, DesignSettings(**common, **wanted), period)
        for wanted in ({}, {"objective": "gain", "rate": 0.1}, {"objective": "band"})
    )
    assert small.certificate.rate == pytest.approx(0.1, rel=1e-3)
    assert np.abs(small.K).sum() < 0.8 * np.abs(fast.K).sum()
    assert fast.certificate.rate > 2 * small.certificate.rate
    widths = [np.max(made.certificate.band) for made in (narrow, fast, small)]
    assert widths[0] <= widths[1] * (1 + 1e-6) < widths[2]


def test_a_sector_that_begins_too_low_is_told_where_it_has_to_begin() -> None:
    agent = attrs.evolve(EXAMPLE_1.agent("tanh"), sector=(0.0, 1.2))
    with pytest.raises(DesignError, match=r"m_l = 0\.\d+ instead of 0 gives") as caught:
        design(agent, EXAMPLE_1.network(2), DesignSettings(phi=10.0), 0.005)
    low = float(re.search(r"m_l = ([\d.]+)", str(caught.value)).group(1))
    for m_l, works in ((low * 1.01, True), (low * 0.98, False)):
        nearby = attrs.evolve(agent, sector=(m_l, 1.2))
        if works:
            made = design(nearby, EXAMPLE_1.network(2), DesignSettings(phi=10.0), 0.005)
            assert made.certificate.failing == ()
        else:
            with pytest.raises(DesignError, match="clash"):
                design(nearby, EXAMPLE_1.network(2), DesignSettings(phi=10.0), 0.005)
