"""Cooling controllers: the C against the numpy statement, and what the shell promises."""

import ctypes
from pathlib import Path

import attrs
import numpy as np
import pytest
from scipy.linalg import expm

import posmas_fmi
from posmas_fmi.cooling import LineParameters
from posmas_fmi.cooling.control import (
    CONTROLLERS,
    WHAT_IS_PROVED,
    controller,
    mean_delays,
    parameters,
)
from posmas_fmi.cooling.law import (
    FALLBACK,
    LineControllers,
    Memory,
    messages,
    own_values,
    start_memory,
)
from posmas_fmi.errors import InputError
from posmas_fmi.fmu.compile import host, shared_library

SOURCES = Path(posmas_fmi.__file__).parent / "cosim" / "csrc" / "cooling"
LINE = LineParameters()
H = 5.0  # s
WATER = 305.15  # K
pointer = ctypes.POINTER(ctypes.c_double)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    files = {name: (SOURCES / name).read_text() for name in ("controller.c", "controller.h")}
    # the shell of a shared library exports nothing else
    files["exports.c"] = "\n".join(
        [
            '#include "controller.h"',
            '#define EXPORT __attribute__((visibility("default")))',
            "EXPORT void step(const Controller *c, const double *own, double t, const double *y,"
            " const double *d, const double *s, const double *m, double *n, double *u, double *a)"
            " { controller_step(c, own, t, y, d, s, m, n, u, a); }",
            "EXPORT void lead(const Controller *c, double t, const double *m, double *n)"
            " { controller_leader(c, t, m, n); }",
            "EXPORT void send(const Controller *c, const double *own, const double *m,"
            " const double *y, double *message) { controller_send(c, own, m, y, message); }",
            "EXPORT int size(void) { return sizeof(Controller); }",
            "EXPORT int sizes(int k) { const int all[] = {MEMORY, MESSAGE, MEASURED, OWN};"
            " return all[k]; }",
        ]
    )
    path = tmp_path_factory.mktemp("c") / "controller.so"
    path.write_bytes(shared_library(files, ["controller.c", "exports.c"], "c", host()))
    return ctypes.CDLL(str(path))


def address(array):
    assert array.dtype == float
    assert array.flags.c_contiguous
    return array.ctypes.data_as(pointer)


class InC:
    """The C functions line by line, with the interface of `LineControllers`."""

    def __init__(self, library, stated):
        self.library = library
        self.c = np.concatenate([v.ravel() for v in stated.values.values()])
        assert library.size() == self.c.nbytes
        self.own = stated.own.rows()

    def step(self, t, measured, disagreement, silence, memory):
        n = len(measured)
        u, applied, after = np.empty((n, 1)), np.empty((n, 1)), np.empty_like(memory)
        for i in range(n):
            rows = [np.ascontiguousarray(a[i]) for a in (measured, disagreement, silence, memory)]
            self.library.step(
                address(self.c),
                address(self.own[i]),
                ctypes.c_double(t),
                *(address(r) for r in rows),
                *(address(a[i]) for a in (after, u, applied)),
            )
        return u, applied, after

    def leader_step(self, t, memory):
        after = np.empty_like(memory)
        self.library.lead(address(self.c), ctypes.c_double(t), address(memory), address(after))
        return after

    def send(self, memory, measured):
        sent = np.empty((len(memory), 4))
        for i in range(len(memory)):
            row, y = np.ascontiguousarray(memory[i]), np.ascontiguousarray(measured[i])
            self.library.send(
                address(self.c), address(self.own[i]), address(row), address(y), address(sent[i])
            )
        return sent


def controllers(name, n=4, **changes):
    control = controller(name, **changes)
    pinned = np.arange(n) == 0
    own = own_values(control, 2.0 + pinned, pinned, size=np.linspace(0.5, 1.6, n))
    return LineControllers(LINE, control, own, H)


def reading(n, random=None, valve=LINE.y0):
    """[return, supply, power, valve, water] near the operating point."""
    y = np.tile([LINE.theta_r0, LINE.theta_s0, LINE.P0, valve, WATER], (n, 1))
    return y if random is None else y + random.normal(size=y.shape) * [2, 1, 2e4, 0.02, 1]


def test_sizes_are_those_of_the_header(library):
    assert [library.sizes(k) for k in range(4)] == [10, 4, 5, 8]


@pytest.mark.parametrize("name", CONTROLLERS)
def test_c_and_numpy_agree(library, name):
    """Random measurements and messages; manual control, silence, stuck valves, missing sensors."""
    random = np.random.default_rng(7)
    stated = controllers(
        name, n=6, floor=WATER + 4.5, opening=(0.05, 0.95), set_point_after=6.0, set_point_at=300.0
    )
    own = attrs.evolve(
        stated.own,
        manual_from=np.array([100, 1e12, 1e12, 150, 1e12, 1e12]),
        manual_until=np.array([200, 1e12, 1e12, 151, 1e12, 1e12]),
        manual_valve=np.full(6, 0.4),
    )
    stated = LineControllers(LINE, stated.control, own, H)
    in_c = InC(library, stated)
    memory = start_memory(np.tile(LINE.theta0, (6, 1)) + random.normal(size=(6, 3)), 5.0)
    leader = np.zeros(10)
    leader[:3] = LINE.theta0
    for k in range(120):
        measured = reading(6, random, valve=0.7)
        measured[5, 2:] = np.nan
        measured[4, 3] = 0.7 if k < 60 else 0.2  # does not follow any more
        disagreement = random.normal(size=(6, 4))
        silence = np.where((random.random((6, 1)) < 0.2), 300.0, 0.0) * np.ones(2)
        np.testing.assert_allclose(
            in_c.send(memory, measured), messages(stated.control, memory, measured), rtol=1e-15
        )
        expected = stated.step(k * H, measured, disagreement, silence, memory)
        for got, wanted in zip(
            in_c.step(k * H, measured, disagreement, silence, memory), expected, strict=True
        ):
            np.testing.assert_allclose(got, wanted, rtol=1e-10, atol=1e-9)
        memory = expected[2]
        np.testing.assert_allclose(
            in_c.leader_step(k * H, leader), stated.leader_step(k * H, leader), rtol=1e-12
        )
        leader = stated.leader_step(k * H, leader)


# ---- the shell ----------------------------------------------------------------------------------


def drive(stated, steps, supply, disagreement, memory=None, silence=0.0, start=0, valve=None):
    """Run open loop with constant measurements; the valve follows unless it is given."""
    n = len(stated.own.size)
    if stated.control.law == "set_point":
        disagreement = 0.0  # of estimates of the set-point, which agree
    if memory is None:
        memory = start_memory(np.tile(LINE.theta0, (n, 1)), stated.set_point(start * H))
    positions = []
    position = np.full(n, LINE.y0)
    for k in range(start, start + steps):
        measured = reading(n)
        measured[:, 1] = supply
        measured[:, 2] *= stated.own.size
        measured[:, 3] = position if valve is None else valve
        v, _, memory = stated.step(
            k * H, measured, np.full((n, 4), disagreement), np.full((n, 2), silence), memory
        )
        position = stated.valve.y0 - stated.valve.gain * v[:, 0]
        positions.append(position)
    return np.array(positions), memory


LAWS_WITH_AN_INTEGRAL = ["integral", "integral_ff", "set_point", "pi", "pi_ff", "team"]


@pytest.mark.parametrize("name", LAWS_WITH_AN_INTEGRAL)
def test_half_an_hour_at_the_limit_winds_nothing_up(name):
    stated = controllers(name)
    hot, memory = drive(stated, 360, supply=8.0, disagreement=3.0)
    np.testing.assert_allclose(hot[-1], 1.0)
    back, _ = drive(stated, 24, 3.0, -2.0, memory, start=360)
    assert (back[3] < 0.999).all()  # leaves the limit within 20 s, not after half an hour
    no_protection = controllers(name, tracking=1e9)
    _, wound = drive(no_protection, 360, supply=8.0, disagreement=3.0)
    stays, _ = drive(no_protection, 24, 3.0, -2.0, wound, start=360)
    assert (stays[3] == 1.0).all()


@pytest.mark.parametrize("name", LAWS_WITH_AN_INTEGRAL)
def test_a_stuck_valve_winds_nothing_up(name):
    stated = controllers(name)
    _, memory = drive(stated, 360, 8.0, 3.0, valve=0.5)
    back, _ = drive(stated, 40, 4.0, -1.0, memory, start=360)
    assert (back[-1] < 0.99).all()
    memory = Memory.of(memory)
    feedback = (stated.valve.y0 - 0.5) / stated.valve.gain
    assert (np.abs(memory.integral - feedback) < 60e3).all()


@pytest.mark.parametrize("name", CONTROLLERS)
def test_valve_keeps_its_limits_and_its_rate(name):
    stated = controllers(name, opening=(0.2, 0.9))
    random = np.random.default_rng(3)
    memory = start_memory(np.tile(LINE.theta0, (4, 1)), 5.0)
    before = np.full(4, LINE.y0)
    for k in range(200):
        measured = reading(4, random)
        measured[:, 3] = before
        v, _, memory = stated.step(
            k * H, measured, 50 * random.normal(size=(4, 4)), np.zeros((4, 2)), memory
        )
        position = stated.valve.y0 - stated.valve.gain * v[:, 0]
        assert (position >= 0.2 - 1e-12).all()
        assert (position <= 0.9 + 1e-12).all()
        assert (np.abs(position - before) <= H / 120 + 1e-12).all()
        before = position


@pytest.mark.parametrize("name", [n for n in CONTROLLERS if n not in ("printed", "proportional")])
def test_starts_where_the_valve_is(name):
    stated = controllers(name)
    first, _ = drive(stated, 1, supply=5.5, disagreement=0.5, valve=0.6)
    np.testing.assert_allclose(first[0], 0.6, atol=1e-12)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_manual_and_back_without_a_bump(name):
    stated = controllers(name)
    whole = np.ones(4)
    own = attrs.evolve(
        stated.own, manual_from=100 * whole, manual_until=600 * whole, manual_valve=0.5 * whole
    )
    stated = LineControllers(LINE, stated.control, own, H)
    positions, _ = drive(stated, 150, supply=5.2, disagreement=0.2)
    np.testing.assert_allclose(positions[119], 0.5, atol=1e-12)
    moved = np.abs(np.diff(positions, axis=0))
    after = slice(119, 121)
    # what an integral does in one period, or a proportional law forgets; 0.2 would be a bump
    assert (moved[after] < 0.025).all()


@pytest.mark.parametrize("name", ["proportional", "integral", "integral_ff", "team"])
def test_goes_over_to_its_own_pi_and_back_without_a_bump(name):
    stated = controllers(name)
    _, memory = drive(stated, 100, supply=5.0, disagreement=0.0)
    assert (Memory.of(memory).mode != FALLBACK).all()
    alone, memory = drive(stated, 10, 5.0, 0.0, memory, silence=500.0, start=100)
    assert (Memory.of(memory).mode == FALLBACK).all()
    assert (np.abs(np.diff(alone[:2], axis=0)) < 0.01).all()
    warmer, memory = drive(stated, 10, 6.0, 0.0, memory, silence=500.0, start=110)
    assert (warmer[-1] > alone[-1] + 0.05).all()  # works against its own deviation
    again, _ = drive(stated, 2, 6.0, 0.0, memory, start=120)
    assert (np.abs(again - warmer[-1]) < 0.025).all()


def test_fallback_holds_what_the_neighbours_agreed_on():
    stated = controllers("integral")
    degree = stated.own.degree[1]
    _, memory = drive(stated, 720, supply=5.0, disagreement=-1.5 * degree)  # they are at 6.5
    assert Memory.of(memory).reference[1] == pytest.approx(6.5, abs=0.01)


@pytest.mark.parametrize("name", LAWS_WITH_AN_INTEGRAL)
def test_closes_before_the_dew_point(name):
    """Everything else wants more cooling, the supply is at the dew point."""
    stated = controllers(name, floor=WATER + 4.0, set_point=2.0)
    positions, _ = drive(stated, 240, supply=3.0, disagreement=1.0)
    assert (positions[-1] < 0.2).all()
    unguarded, _ = drive(controllers(name, set_point=2.0), 240, supply=3.0, disagreement=1.0)
    assert (unguarded[-1] > 0.9).all()


def test_printed_sign_is_in_the_weights_only():
    a, b = (parameters(LINE, controller(n), H) for n in ("printed", "proportional"))
    assert all(np.array_equal(a[k], b[k]) for k in a)


@pytest.mark.parametrize("set_point", [4.0, 5.0, 6.5])
@pytest.mark.parametrize("water", [-0.5, 0.0, 1.0])
@pytest.mark.parametrize("load", [0.35, 1.0, 1.3])
def test_feedforward_holds_the_set_point_by_itself(set_point, water, load):
    """In the steady state of a load and a water temperature nothing is left for the law to do."""
    stated = controllers("pi_ff", n=1, set_point=set_point)
    v = stated.ahead(np.array([load]), np.array([water]))[0]
    kappa, power = float(LINE.kappa(stated.valve.position(v))), load * LINE.P0
    heat = [power * (1 - LINE.kl * LINE.theta_p0) / LINE.Cp, 0.0, kappa * water / LINE.Cs]
    theta = np.linalg.solve(LINE.A(kappa, power), -np.array(heat))
    assert theta[2] == pytest.approx(set_point, abs=2e-3)


@pytest.mark.parametrize(
    ("load", "water", "end"), [(9.0, 0.0, 1.0), (1.0, 30.0, 1.0), (0.0, 0, 0.0)]
)
def test_feedforward_ends_at_the_ends_of_the_valve(load, water, end):
    stated = controllers("pi_ff", n=1)
    v = stated.ahead(np.array([load]), np.array([water]))[0]
    assert stated.valve.position(v) == pytest.approx(end, abs=1e-12)


def test_feedforward_follows_with_the_lag_of_the_load():
    """A valve that lags by the difference of the mean delays leaves no area of deviation."""
    behind_load, behind_valve = mean_delays(LINE)
    A = LINE.A(LINE.kappa0, LINE.P0)
    times = np.arange(0.0, 2000.0, 2.0) + 1.0
    response = np.array([expm(A * t)[2, [0, 2]] for t in times])
    mean = (response * times[:, None]).sum(axis=0) / response.sum(axis=0)
    np.testing.assert_allclose(mean, [behind_load, behind_valve], rtol=0.02)
    values = parameters(LINE, controller("pi_ff"), H)
    assert values["ff_time"][0] == behind_load - behind_valve
    assert parameters(LINE, controller("pi_ff", feedforward_time=90.0), H)["ff_time"][0] == 90.0


def test_leader_settles_at_the_set_point():
    stated = controllers("integral", set_point=6.0)
    memory = np.zeros(10)
    memory[:3] = LINE.theta0
    for k in range(400):
        memory = stated.leader_step(k * H, memory)
    assert memory[2] == pytest.approx(6.0, abs=1e-9)
    assert memory[5] == 6.0


def test_estimate_has_no_bias_under_unequal_load():
    """Fed with IT power and valve feedback, the observer finds the plate, which nobody measures."""
    stated = controllers("fixed", n=1)
    load, y = 110e3, 0.6
    truth = LINE.steady(load, y)
    memory = start_memory(LINE.theta0[None, :], 5.0)
    measured = np.array([[truth[1], truth[2], load * stated.own.size[0], y, WATER]])
    for k in range(200):
        _, _, memory = stated.step(k * H, measured, np.zeros((1, 4)), np.zeros((1, 2)), memory)
    np.testing.assert_allclose(memory[0, :3], truth, rtol=1e-6)


def test_every_controller_says_what_is_proved():
    assert set(WHAT_IS_PROVED) == {*CONTROLLERS, "mpc"}  # which is no law of the C source


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"K": [1.0]}, "shape"),
        ({"kp": -0.1}, "> 0"),
        ({"K_q": 3.0}, "<= 0"),
        ({"feedforward_time": 0.0}, "> 0"),
        ({"opening": (0.9, 0.1)}, "low < high"),
        ({"silence": -1.0}, ">= 0"),
        ({"sign": "wrong"}, "corrected"),
    ],
)
def test_nonsense_is_refused(changes, word):
    with pytest.raises(InputError, match=word):
        controller("integral", **changes)


def test_unknown_controller_is_refused():
    with pytest.raises(InputError, match="integral_ff"):
        controller("nonsense")
