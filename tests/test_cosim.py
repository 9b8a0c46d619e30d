import attrs
import numpy as np
import paper
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from posmas_fmi.agent import linear_agent
from posmas_fmi.cosim.channel import Channel, Mailbox
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.continuous import continuous
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import System, simulate
from posmas_fmi.cosim.plant import CallablePlant, ModelPlant
from posmas_fmi.cosim.propagator import Propagator
from posmas_fmi.errors import FmuCallError, InputError
from posmas_fmi.network import network_from_arcs
from posmas_fmi.protocol import make_protocol


def system(agent, network, protocol, clock, xhat0, s0, **channel):
    arcs = network.adjacency.nnz + len(network.pinned)
    law = ProtocolLaw(agent, protocol)
    return System(
        agent, network, law, Channel.uniform(arcs, clock.h, **channel), clock, xhat0, s0, 1
    )


def example_1(h, until=1.0, observer="local", **channel):
    agent, network = paper.agent(1), paper.network(1)
    K, E = paper.PRINTED[1, 1 if observer == "local" else 2]
    protocol = make_protocol(network, K, E, paper.PHI[1], paper.MU[1], observer)
    x0 = np.random.default_rng(1).uniform(0, 2, (4, 2))
    clock = Clock.of(until, h)
    s0 = np.ones(2)
    return system(agent, network, protocol, clock, np.zeros((4, 2)), s0, **channel), x0


# ---- equations (6), (5), (22) ---------------------------------------------------------------


@pytest.mark.parametrize("form", ["corrected", "printed"])
def test_equation_6_term_by_term(form):
    network, rng = paper.network(1), np.random.default_rng(0)
    K, phi = np.array([[-0.4, -0.6]]), 10.0
    protocol = make_protocol(network, K, np.zeros((2, 2)), phi, form=form)
    xhat, s = rng.uniform(0, 2, (4, 2)), rng.uniform(0, 2, 2)
    u = protocol.control(xhat, xhat[network.adjacency.indices], s)
    a, d = network.adjacency.toarray(), network.pinning
    sign = 1 if form == "corrected" else -1  # erratum 1
    for i in range(4):
        neighbours = sum(a[i, j] * (xhat[i] - xhat[j]) for j in range(4))
        expected = phi * K @ neighbours + sign * phi * d[i] * K @ (xhat[i] - s)
        np.testing.assert_allclose(u[i], expected)


@pytest.mark.parametrize("form", ["corrected", "printed"])
def test_distributed_observer_term_by_term(form):
    network, rng = paper.network(1), np.random.default_rng(0)
    E, mu = rng.uniform(0, 1, (2, 2)), 15.0
    protocol = make_protocol(network, np.zeros((1, 2)), E, 1.0, mu, "distributed", form)
    r = rng.uniform(0, 2, (4, 2))  # y - C xhat
    correction = protocol.injection(r, r[network.adjacency.indices])
    if form == "corrected":  # (25)
        expected = mu * network.pinned_laplacian.toarray() @ r @ E.T
    else:  # (22)
        a, d = network.adjacency.toarray(), network.pinning
        rows = [-d[i] * (r[i] + sum(a[i, j] * (r[i] - r[j]) for j in range(4))) for i in range(4)]
        expected = mu * np.array(rows) @ E.T
    np.testing.assert_allclose(correction, expected)


def test_local_observer_uses_only_its_own_output():
    network = paper.network(1)
    protocol = make_protocol(network, np.zeros((1, 2)), np.eye(2), 1.0)
    r = np.arange(8.0).reshape(4, 2)
    np.testing.assert_allclose(protocol.injection(r, 1e9 * r[network.adjacency.indices]), r)


# ---- propagation ------------------------------------------------------------------------------


def test_linear_part_is_exact_at_any_step():
    A = np.array([[-3.0, 1.0], [2.0, -5.0]])
    step = Propagator.of(linear_agent(A, [[1.0], [0.0]], [[1.0, 0.0]]), h=2.0)
    x, w = np.array([1.0, 2.0]), np.array([0.3, -0.1])
    steady = -np.linalg.solve(A, w)
    expected = steady + scipy.linalg.expm(2.0 * A) @ (x - steady)
    np.testing.assert_allclose(step(0.0, x[None], w[None])[0], expected, rtol=1e-12)


def test_singular_linear_part_is_an_integrator():
    step = Propagator.of(linear_agent([[0.0]], [[1.0]], [[1.0]]), h=0.5)
    np.testing.assert_allclose(step(0.0, np.array([[1.0]]), np.array([[2.0]])), [[2.0]])


def test_nonlinear_part_is_of_fourth_order():
    agent = paper.agent(1)
    x0, t0, span = np.array([1.0, 0.7]), 0.5, 0.4

    def rhs(t, x):
        return agent.A @ x + agent.H @ agent.g_numpy(t, x[None])[0]

    exact = solve_ivp(rhs, (t0, t0 + span), x0, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    errors = []
    for n in (10, 20, 40):
        step, x = Propagator.of(agent, span / n), x0[None]
        for k in range(n):
            x = step(t0 + k * span / n, x, np.zeros((1, 2)))
        errors.append(np.abs(x[0] - exact).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 3.7).all(), (errors, orders)


@pytest.mark.parametrize("example", [1, 2])
def test_one_step_of_the_observer_is_within_1e_6_of_the_flow(example):
    """What docs/theory.md says: the certificate takes this step as exact."""
    agent, h, rng = paper.agent(example), 0.005, np.random.default_rng(0)
    step, worst = Propagator.of(agent, h), 0.0
    for _ in range(100):
        x, w, t0 = rng.uniform(0, 4, 2), rng.uniform(-5, 5, 2), rng.uniform(0, 10)

        def rhs(t, z, w=w):
            return agent.A @ z + agent.H @ agent.g_numpy(t, z[None])[0] + w

        exact = solve_ivp(rhs, (t0, t0 + h), x, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
        worst = max(worst, np.abs(step(t0, x[None], w[None])[0] - exact).max())
    assert worst < 1e-6


# ---- clock --------------------------------------------------------------------------------------


def test_time_does_not_drift():
    clock = Clock.of(until=3600.0, period=0.1)
    assert clock.steps == 36000
    assert clock.time(36000) == 3600.0
    assert clock.time(3) == 0.3  # the sum 0.1 + 0.1 + 0.1 is not


@pytest.mark.parametrize("parts", [3, 7, 60, 44_100])
def test_a_period_may_be_a_fraction_of_a_second(parts):
    """A display or a container of FMUs has steps of 1/60 s, which is no number of nanoseconds."""
    clock = Clock.of(until=3600.0, period=1 / parts)
    assert (clock.h, clock.steps, clock.time(3600 * parts)) == (1 / parts, 3600 * parts, 3600.0)
    assert clock.time(parts // 2) == (parts // 2) / parts
    with pytest.raises(InputError, match="multiple of the period"):
        Clock.of(until=1.0 + 0.4 / parts, period=1 / parts)


@pytest.mark.parametrize(
    ("until", "period", "place"),
    [(1.0, 0.3, "until"), (0.1, 0.2, "until"), (1.0, 1e-10, "period"), (1.0, np.pi / 9, "period")],
)
def test_periods_that_do_not_fit_are_refused(until, period, place):
    with pytest.raises(InputError) as caught:
        Clock.of(until, period)
    assert caught.value.where == f"$.scenario.{place}"


# ---- channel ----------------------------------------------------------------------------------


def sent_over(channel, steps, seed=0):
    """What one arc holds at each step when step k sends the value k."""
    first = np.array([[-1.0]])
    mailbox = Mailbox(channel, first, np.random.default_rng(seed))
    return [float(mailbox.exchange(k, np.array([[float(k)]]))[0, 0]) for k in range(steps)], mailbox


def test_ideal_channel_delivers_at_once():
    assert sent_over(Channel.uniform(1, 1.0), 4)[0] == [0, 1, 2, 3]


def test_delay_is_whole_steps_rounded_up():
    assert sent_over(Channel.uniform(1, 1.0, delay=1.2), 5)[0] == [-1, -1, 0, 1, 2]


def test_lost_messages_leave_the_last_value():
    held, mailbox = sent_over(Channel.uniform(1, 1.0, loss=0.5), 200)
    changes = np.diff(held)
    assert (changes >= 0).all()
    assert (changes == 0).any()
    assert mailbox.sent == 200
    assert 60 < mailbox.lost < 140
    assert sent_over(Channel.uniform(1, 1.0, loss=1.0), 5)[0] == [-1] * 5


@given(delay=st.integers(0, 3), jitter=st.integers(0, 4), seed=st.integers(0, 99))
def test_with_jitter_the_newest_that_has_arrived_is_held(delay, jitter, seed):
    channel = Channel.uniform(1, 1.0, delay=delay, jitter=jitter)
    held, _ = sent_over(channel, 40, seed)
    age = [k - value for k, value in enumerate(held) if value >= 0]
    assert (np.diff(held) >= 0).all()  # never an older one after a newer one
    assert min(age) >= delay
    assert max(age) <= delay + jitter + jitter  # held at most until the next can have come


def test_bad_channels_are_refused():
    for bad in ({"delay": -1.0}, {"loss": 1.5}, {"jitter": np.inf}, {"loss": np.nan}):
        with pytest.raises(InputError):
            Channel.uniform(1, 1.0, **bad)


# ---- the loop -----------------------------------------------------------------------------------


def test_order_of_calls_is_read_then_step():
    agent, network = linear_agent([[-1.0]], [[1.0]], [[1.0]]), network_from_arcs(1, [], [1])
    protocol = make_protocol(network, [[-1.0]], [[0.5]], 1.0)
    plant = CallablePlant(lambda x: x, lambda t, h, x, U: x + h * U, np.array([[2.0]]))
    rows = []
    definition = system(agent, network, protocol, Clock.of(0.3, 0.1), np.zeros((1, 1)), np.ones(1))
    outcome = simulate(definition, plant, lambda t, row: rows.append((t, row)))
    assert plant.calls == ["outputs", "step"] * 3 + ["outputs"]
    assert [t for t, _ in rows] == [0.0, 0.1, 0.2, 0.3]
    assert outcome.ended == "complete"
    # u_0 = K(xhat - s) = 1 is held over the first step
    np.testing.assert_allclose(rows[0][1]["u"], [[1.0]])
    np.testing.assert_allclose(rows[1][1]["x"], [[2.1]])


@pytest.mark.parametrize("observer", ["local", "distributed"])
def test_the_sampled_loop_tends_to_the_continuous_protocol(observer):
    errors = []
    for h in (0.01, 0.005, 0.0025):
        definition, x0 = example_1(h, observer=observer)
        plant = ModelPlant(definition.agent, x0)
        simulate(definition, plant)
        oracle = continuous(
            definition.agent,
            definition.network,
            definition.law.protocol,
            x0,
            definition.xhat0,
            definition.s0,
            np.array([0.0, 1.0]),
        )
        errors.append(np.abs(plant.x - oracle["x"][-1]).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 0.75).all(), (errors, orders)
    assert np.log2(errors[0] / errors[-1]) / 2 > 0.85  # first order in the period
    assert errors[-1] < 2e-3


def test_example_1_reaches_the_leader_with_printed_gains_and_corrected_sign():
    """Erratum 1: with L + D the printed gains work."""
    definition, x0 = example_1(0.005, until=6.0)
    outcome = simulate(definition, ModelPlant(definition.agent, x0, rtol=1e-8))
    assert outcome.tracking_error.max() < 1e-4
    assert outcome.min_state.min() >= 0


def test_erratum_5_example_2_loses_positivity_with_its_printed_gain():
    agent, network = paper.agent(2), paper.network(2)
    K, E = paper.PRINTED[2, 1]
    protocol = make_protocol(network, K, E, paper.PHI[2])
    x0 = np.zeros((9, 2))
    x0[3] = [2.0, 0.0]  # the agent that hears four others
    assert network.in_degree[3] == 4
    clock = Clock.of(0.5, 0.001)
    definition = system(agent, network, protocol, clock, x0.copy(), np.zeros(2))
    outcome = simulate(definition, ModelPlant(agent, x0, rtol=1e-8))
    assert outcome.min_state.min() == pytest.approx(-0.40, abs=0.01)


@pytest.mark.parametrize(
    "channel", [{"delay": 0.02}, {"loss": 0.3}, {"delay": 0.01, "jitter": 0.01}]
)
def test_delay_and_loss_do_not_keep_the_agents_from_a_leader_at_rest(channel):
    """Certificate D. The leader rests at zero; one that moves is followed with a lag."""
    definition, x0 = example_1(0.005, until=4.0, **channel)
    definition = attrs.evolve(definition, s0=np.zeros(2))
    outcome = simulate(definition, ModelPlant(definition.agent, x0, rtol=1e-8))
    assert outcome.ended == "complete"
    assert outcome.tracking_error.max() < 1e-2 * outcome.largest_initial
    assert outcome.min_state.min() >= 0


def test_a_failing_plant_ends_the_run_and_keeps_what_was_recorded():
    definition, x0 = example_1(0.01)

    def advance(t, h, x, U):
        if round(t / h) == 7:
            raise FmuCallError("doStep returned Error", "plant.fmu, doStep", "3", t)
        return x

    rows = []
    plant = CallablePlant(lambda x: x @ definition.agent.C.T, advance, x0)
    outcome = simulate(definition, plant, lambda t, row: rows.append(t))
    assert (outcome.ended, outcome.steps, outcome.failed_agent) == ("failed", 7, "3")
    assert "doStep returned Error" in outcome.reason
    assert len(rows) == 8


def test_an_interrupt_ends_the_run_as_cancelled():
    definition, x0 = example_1(0.01)

    def progress(done, total):
        if done == 5:
            raise KeyboardInterrupt

    outcome = simulate(definition, ModelPlant(definition.agent, x0, 1e-6), progress=progress)
    assert (outcome.ended, outcome.steps) == ("cancelled", 5)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e12])
def test_values_that_run_away_end_the_run_as_diverged(value):
    definition, x0 = example_1(0.01)

    def advance(t, h, x, U):
        x = x.copy()
        x[2] = value if round(t / h) == 3 else x[2]
        return x

    def output(x):
        with np.errstate(invalid="ignore"):
            return x @ definition.agent.C.T

    outcome = simulate(definition, CallablePlant(output, advance, x0))
    assert outcome.ended == "diverged"
    assert outcome.steps == 4
    assert "agent 3" in outcome.reason
