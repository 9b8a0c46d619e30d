"""The cooling line: reference figures, exchanger, mapping to model (1), computed sectors."""

from __future__ import annotations

import math

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from posmas_fmi.agent import is_metzler
from posmas_fmi.cooling import (
    LineParameters,
    header_values,
    line_agent,
    line_values,
    return_range,
    sector,
    slope_sector,
    valve_mapping,
)
from posmas_fmi.cooling.exchanger import conductance, conductance_slope
from posmas_fmi.errors import InputError

LINE = LineParameters()
AGENT = line_agent(LINE)
SECTOR = sector(LINE, (7.0, 24.0))
positions = st.floats(0.0, 1.0)
headers = st.floats(0.0, 4.0)


def effectiveness(UA: float, hot: float, cold: float) -> float:
    """The textbook's formula, with its case for equal streams."""
    least, most = min(hot, cold), max(hot, cold)
    ratio, ntu, gap = least / most, UA / least, (most - least) / most
    if gap == 0:
        return least * ntu / (1 + ntu)
    # 1 - exp(-ntu·gap) in a form that keeps its digits where the streams are nearly equal
    gone = -math.expm1(-ntu * gap)
    return least * gone / (gap + ratio * gone)


# ---- the exchanger ------------------------------------------------------------------------------


@given(st.floats(1.0, 1e6), st.floats(1.0, 1e6), st.floats(1.0, 1e6))
def test_the_exchanger_is_the_textbooks(UA: float, hot: float, cold: float) -> None:
    expected = effectiveness(UA, hot, cold)
    assert float(conductance(UA, hot, cold)) == pytest.approx(expected, rel=1e-9)


@given(st.floats(1.0, 1e6), st.floats(1.0, 1e6), st.floats(1.0, 1e6))
def test_no_more_heat_than_either_stream_can_carry(UA: float, hot: float, cold: float) -> None:
    assert 0 < conductance(UA, hot, cold) <= min(hot, cold) * (1 + 1e-14)
    assert 0 <= conductance_slope(UA, hot, cold) <= 1 + 1e-12


@pytest.mark.parametrize("cold", [10.0, 500.0, 7.9e3, 8e3, 8.0001e3, 15e3, 1e6])
def test_the_exchangers_slope(cold: float) -> None:
    step = 1e-5 * cold
    around = conductance(20e3, 8e3, np.array([cold - step, cold + step]))
    slope = float(np.diff(around)[0] / (2 * step))
    assert float(conductance_slope(20e3, 8e3, cold)) == pytest.approx(slope, rel=1e-6, abs=1e-9)


def test_a_stream_that_stands_still_takes_no_heat() -> None:
    assert conductance(20e3, 8e3, 0.0) == 0
    assert conductance(20e3, [0.0, 8e3], 8e3).tolist() == [0.0, pytest.approx(5714.2857)]


# ---- the line -----------------------------------------------------------------------------------


def test_the_operating_point() -> None:
    np.testing.assert_allclose(LINE.theta0, [26.7, 15.0, 5.0], atol=0.005)
    assert pytest.approx(0.717, abs=5e-4) == LINE.y0
    np.testing.assert_allclose(LINE.steady(LINE.P0), LINE.theta0, rtol=1e-12)


def test_the_slowest_pole() -> None:
    assert LINE.time_constants()[0] == pytest.approx(38, abs=0.5)
    assert LINE.time_constants(y=0.3)[0] == pytest.approx(219, abs=0.5)


def test_the_static_gains() -> None:
    g_d, g_u = LINE.static_gains()
    assert 10e3 * g_d == pytest.approx(0.70, abs=0.005)
    assert 10e3 * g_u == pytest.approx(1.92, abs=0.005)


def test_the_static_gains_are_those_of_the_steady_state() -> None:
    g_d, g_u = LINE.static_gains()
    # heat that is retained: less is taken away by the exchanger
    dP, dy = 1.0, 1e-6
    slope = (LINE.steady(LINE.P0 + dP)[2] - LINE.steady(LINE.P0 - dP)[2]) / (2 * dP)
    assert slope == pytest.approx(g_d, rel=1e-6)
    by_valve = (LINE.steady(LINE.P0, LINE.y0 - dy)[2] - LINE.steady(LINE.P0, LINE.y0 + dy)[2]) / 2
    retained = float(LINE.kappa_slope(LINE.y0)) * LINE.theta_r0 * dy
    assert by_valve / retained == pytest.approx(g_u, rel=1e-5)


@given(positions, headers, st.floats(0.0, 130e3))
def test_positivity_is_structural(y: float, h: float, P: float) -> None:
    kappa = float(LINE.kappa(y, h))
    assert 0 <= kappa <= LINE.ws
    assert is_metzler(LINE.A(kappa, P))


@given(positions, st.floats(0.1, 4.0))
def test_the_slope_of_kappa(y: float, h: float) -> None:
    step = 1e-6
    change = float(LINE.kappa(y + step, h) - LINE.kappa(y - step, h)) / (2 * step)
    assert float(LINE.kappa_slope(y, h)) == pytest.approx(change, rel=1e-5, abs=1e-3)


@pytest.mark.parametrize(("P", "theta_s", "h"), [(40e3, 5.0, 1.0), (130e3, 5.0, 1.0), (80e3, 7, 2)])
def test_the_valve_position_holds_the_supply(P: float, theta_s: float, h: float) -> None:
    y = LINE.position(P, theta_s, h)
    assert LINE.steady(P, y, h)[2] == pytest.approx(theta_s, rel=1e-9)


@pytest.mark.parametrize("power", [40e3, 130e3])
def test_lines_of_other_sizes_are_the_same_in_temperature(power: float) -> None:
    sized = LINE.sized(power)
    np.testing.assert_allclose(sized.theta0, LINE.theta0)
    np.testing.assert_allclose(sized.time_constants(), LINE.time_constants())
    assert sized.y0 == pytest.approx(LINE.y0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"UA": 0.0}, "line.UA: expected a number > 0"),
        ({"Cp": math.nan}, "line.Cp"),
        ({"R": 1.0}, "rangeability"),
        ({"N": 1.5}, "authority"),
        ({"kl": -0.1}, "leakage"),
        ({"ws": 2e3, "P0": 20e3}, "Metzler"),
        ({"UA": 1e3}, "P0 = 80000 W needs"),
    ],
)
def test_lines_that_cannot_be(changes: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        attrs.evolve(LINE, **changes)


def test_loads_that_cannot_be_held() -> None:
    with pytest.raises(InputError, match="needs κ"):
        LINE.position(400e3)
    with pytest.raises(InputError, match="runaway"):
        attrs.evolve(LINE, kl=0.04).steady(400e3, 0.1)


# ---- the mapping --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("theta_r", "low", "high"), [(7.0, 0.25, 0.59), (14.0, 0.50, 1.18), (24.0, 0.85, 2.02)]
)
def test_the_sector_at_a_return_temperature(theta_r: float, low: float, high: float) -> None:
    found = sector(LINE, (theta_r, theta_r))
    assert found == pytest.approx((low, high), abs=0.008)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(positions, st.floats(7.0, 24.0)), min_size=50, max_size=50))
def test_no_gain_lies_outside_the_sector(points: list[tuple[float, float]]) -> None:
    low, high = SECTOR
    valve = valve_mapping(LINE)
    for y, theta_r in points:
        u = valve.retained(y)
        if abs(u) > 1.0:
            gain = -float(LINE.kappa(y) - LINE.kappa0) * theta_r / u
            assert low <= gain <= high


def test_the_sector_is_tight() -> None:
    y = np.linspace(0.0, 1.0, 20001)
    y = y[np.abs(y - LINE.y0) > 1e-3]
    gain = valve_mapping(LINE).gain * (LINE.kappa(y) - LINE.kappa0) / (y - LINE.y0)
    assert pytest.approx((7 * gain.min(), 24 * gain.max()), rel=2e-3) == SECTOR


def test_a_valve_that_does_not_close_narrows_the_sector() -> None:
    # the largest gain is that of half strokes, the smallest that of the open valve
    assert sector(LINE, (15.0, 15.0), (0.6, 0.8))[0] > sector(LINE, (15.0, 15.0))[0]


@pytest.mark.parametrize("header", [(1.0, 1.0), (0.3, 2.0)])
def test_the_slope_sector_encloses_and_is_tight(header: tuple[float, float]) -> None:
    low, high = slope_sector(LINE, (10.0, 22.0), (0.3, 1.0), header)
    y, h = np.meshgrid(np.linspace(0.3, 1.0, 701), np.linspace(*header, 201))
    slope = valve_mapping(LINE).gain * LINE.kappa_slope(y, h)
    assert low <= 10 * slope.min() <= low * 1.04
    assert high >= 22 * slope.max() >= high * 0.96


def test_the_slope_of_the_written_line_is_enclosed_also_where_its_text_has_a_kink() -> None:
    agent = line_agent(LINE, theta_r=(14.0, 16.0), opening=(0.3, 1.0))
    assert agent.slope is not None
    valve = valve_mapping(LINE, (0.3, 1.0))
    # both streams of the exchanger are equal where cw wmax kv = ws
    y = np.linspace(0.3, 1.0, 200001)
    per_cold = LINE.ws / (LINE.cw * LINE.wmax * LINE.kv(y))
    kink = valve.retained(float(y[np.abs(per_cold - 1).argmin()]))
    for u in (np.linspace(*valve.inputs, 5001), np.linspace(kink - 100, kink + 100, 5001)):
        values = agent.sec_numpy(u[:, None])[:, 0]
        slopes = np.diff(values) / np.diff(u)
        assert agent.slope[0] < slopes.min() < slopes.max() < agent.slope[1]


@pytest.mark.parametrize(
    ("opening", "header"), [((0.5, 0.5), (1, 1)), ((-0.1, 1), (1, 1)), ((0, 1), (0, 1))]
)
def test_slope_sectors_of_nothing(
    opening: tuple[float, float], header: tuple[float, float]
) -> None:
    with pytest.raises(InputError):
        slope_sector(LINE, (10.0, 22.0), opening, header)


def test_the_valve_mapping() -> None:
    valve = valve_mapping(LINE)
    assert 10e3 * valve.gain == pytest.approx(0.078, abs=5e-4)
    assert valve.retained(valve.position(5e3)) == pytest.approx(5e3)
    assert (valve.position(1e9), valve.position(-1e9)) == (0.0, 1.0)
    assert [valve.position(u) for u in valve.inputs] == pytest.approx([1.0, 0.0])
    with pytest.raises(InputError, match="opening"):
        valve_mapping(LINE, (0.8, 1.0))


def test_the_agent() -> None:
    agent = AGENT
    np.testing.assert_array_equal(agent.A, LINE.A(LINE.kappa0))
    np.testing.assert_array_equal(agent.B, [[0], [0], [1 / LINE.Cs]])
    assert is_metzler(agent.A)
    assert agent.hurwitz
    assert agent.controllable
    assert agent.observable
    # load and leakage: the right-hand side at the operating point is zero
    rate = agent.derivative(0.0, LINE.theta0[None, :], np.zeros((1, 1)))
    np.testing.assert_allclose(rate, 0.0, atol=1e-14)
    assert np.linalg.norm(agent.H, 2) == pytest.approx(0.0133, abs=5e-5)


def test_the_agents_slope_is_the_lines() -> None:
    agent, step = AGENT, 1e-3
    around = [agent.derivative(0.0, LINE.theta0[None, :] + step * e, np.zeros((1, 1)))[0]
              for e in np.vstack([np.eye(3), -np.eye(3)])]  # fmt: skip
    slope = (np.array(around[:3]) - around[3:]).T / (2 * step)
    np.testing.assert_allclose(slope, LINE.A(LINE.kappa0, LINE.P0), atol=1e-11)


@pytest.mark.parametrize("u", [-30e3, -5e3, 1.0, 5e3, 40e3, 80e3])
def test_the_agents_sec_is_the_exchangers(u: float) -> None:
    agent, valve = AGENT, valve_mapping(LINE)
    expected = -float(LINE.kappa(valve.position(u)) - LINE.kappa0) * LINE.theta_r0
    assert float(agent.sec_numpy(np.array([[u]]))[0, 0]) == pytest.approx(
        expected, rel=1e-6, abs=1e-3
    )


def test_the_agents_assumptions_are_verified() -> None:
    status = {a.name: a.status for a in AGENT.assumptions()}
    assert status == {"sector": "verified", "lipschitz": "verified", "growth": "verified"}


def test_the_sampled_loop_of_a_row_is_certified() -> None:
    from posmas_fmi.design import DesignSettings, design
    from posmas_fmi.network import network_from_arcs

    arcs = [((i - hop) % 8 + 1, i + 1) for i in range(8) for hop in (1, 3)]
    network = network_from_arcs(8, arcs, pinned=[1])
    made = design(AGENT, network, DesignSettings(method="contraction"), 5.0)
    assert made.certificate.certified == "yes"
    assert made.certificate.rate > 0


def test_condition_13_holds_with_the_observer_gain_of_the_brief() -> None:
    agent = AGENT
    closed = agent.A - np.array([[0, 0], [0.05, 0], [0, 0.1]]) @ agent.C
    assert is_metzler(closed)
    smallest = [
        np.linalg.svd(closed - 1j * w * np.eye(3), compute_uv=False)[-1]
        for w in np.linspace(0, 1, 2001)
    ]
    assert min(smallest) == pytest.approx(0.073, abs=5e-4)
    assert min(smallest) > np.linalg.norm(agent.H_ell, 2)  # up to 130 kW, not only at 80 kW


def test_the_return_range_covers_fixed_and_held_valves() -> None:
    low, high = return_range(LINE)
    assert low == pytest.approx(LINE.steady(40e3)[1])
    assert high == pytest.approx(LINE.steady(130e3)[1])
    for load in (40e3, 75e3, 130e3):
        assert low <= LINE.steady(load, LINE.position(load))[1] <= high
    with pytest.raises(InputError, match="loads"):
        return_range(LINE, (50e3, 40e3))


def test_a_line_without_leakage_has_an_agent() -> None:
    line = attrs.evolve(LINE, kl=0.0)
    agent = line_agent(line)
    rate = agent.derivative(0.0, line.theta0[None, :], np.zeros((1, 1)))
    np.testing.assert_allclose(rate, 0.0, atol=1e-14)
    assert not agent.H_ell.any()


def test_the_agent_of_an_integral_design_leaks_as_at_its_load() -> None:
    agent = line_agent(LINE, integral=True)
    rate = agent.derivative(0.0, LINE.theta0[None, :], np.zeros((1, 1)))
    np.testing.assert_allclose(rate, 0.0, atol=1e-14)
    np.testing.assert_array_equal(agent.A, LINE.A(LINE.kappa0, LINE.P0))
    assert not agent.H_ell.any()
    assert agent.slope == AGENT.slope


# ---- values for the FMUs ------------------------------------------------------------------------


def test_the_values_of_the_plants_are_those_of_their_files() -> None:
    from posmas_fmi.fmu.plant import read_plant, shipped_plants

    given = {"cooling_line": line_values(LINE), "facility_header": header_values(LINE, 8)}
    for name, values in given.items():
        start = {v.name: v.start for v in read_plant(shipped_plants()[name]).variables}
        for key, value in values.items():
            assert start[key] == pytest.approx((value,), rel=1e-3), key


def test_values_that_cannot_be() -> None:
    with pytest.raises(InputError, match="lines"):
        header_values(LINE, 0)
    with pytest.raises(InputError, match=r"G < 2 ws"):
        line_values(attrs.evolve(LINE, G=16e3))
