# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A cooling row: from the FMU to a decision
#
# Eight liquid-cooling lines stand in a row and share one facility water header. Which controller
# should run their valves? This notebook looks at one line as an FMU, proves what a design can
# promise, then runs the whole row, with the same loads, under several controllers: once with ample
# water, once with too little of it.

# %%
import control
import matplotlib.pyplot as plt
import numpy as np

from posmas_fmi import network_from_arcs
from posmas_fmi.cooling import (
    LineParameters,
    Loads,
    controller,
    generate_loads,
    line_agent,
    line_values,
)
from posmas_fmi.cooling.row import Row, simulate_row
from posmas_fmi.design import DesignSettings, design
from posmas_fmi.fmu.build import fmu
from posmas_fmi.fmu.linearise import linearise
from posmas_fmi.fmu.plant import read_plant, shipped_plants

STYLE = {
    "proportional": ("#d55e00", "--"),
    "integral": ("#0072b2", "-"),
    "integral_ff": ("#009e73", "-"),
    "pi": ("#767676", ":"),
    "pi_ff": ("#1a1a1a", "-."),
}
plt.rcParams.update({"figure.dpi": 110, "axes.spines.top": False, "axes.spines.right": False})

# %% [markdown]
# ## One line is an FMU
#
# `cooling_line` is a cold-plate loop of 80 kW with its heat exchanger and valve. Around its
# operating point it is a linear system, and python-control can take it from there. Five of the
# states are temperatures, two are valve and pump, and two are meters of energy, which only add up.

# %%
line = LineParameters()
path = fmu(read_plant(shipped_plants()["cooling_line"]), 3)
made = linearise(path, ["valve", "heat_load"], ["supply_temperature"], values=line_values(line))
system = control.ss(made.A, made.B, made.C, made.D)
poles = control.poles(system).real
slowest = -1 / poles[poles < -1e-9].max()
print(", ".join(made.states))
print(f"slowest time constant {slowest:.0f} s")

seconds = np.linspace(0, 900, 181)
figure, axes = plt.subplots(1, 2, figsize=(9, 2.8), layout="constrained", sharey=True)
for k, (size, what) in enumerate(((0.1, "valve 10 % further open"), (10e3, "10 kW more heat"))):
    answer = control.forced_response(system[0, k], seconds, np.full(len(seconds), size))
    axes[k].plot(seconds / 60, answer.outputs, color=STYLE["integral"][0])
    axes[k].axhline(0, color="#767676", lw=0.8)
    axes[k].set(xlabel="time [min]", title=f"Supply temperature: {what}")
axes[0].set_ylabel("change [K]")
assert 40 < slowest < 50

# %% [markdown]
# ## What a design can promise
#
# `line_agent` writes the line as model (1): the input is the heat that the valve retains. The valve
# curve, the exchanger and the range of loads from 40 to 130 kW are in the bounds of its sector,
# computed by interval arithmetic. So the certificate holds for every load in that range.
#
# Each line hears the two before it; only the first one is told the set-point.

# %%
n = 8
arcs = [(i, (i + hop - 1) % n + 1) for hop in (1, 2) for i in range(1, n + 1)]
network = network_from_arcs(n, arcs, pinned=[1])
agent = line_agent(line)
print(f"sector [{agent.m_l:.3f}, {agent.m_h:.3f}]")
proof = design(agent, network, DesignSettings(), period=5.0).certificate
print(f"certified {proof.certified}, positive {proof.positive}")
for name, rate in (("tracking", proof.rate), ("estimation", proof.observer_rate)):
    print(f"{name}: proved time constant {1 / rate:.0f} s")
for assumption in proof.assumptions:
    print(f"  {assumption.status}: {assumption.name}")
assert proof.certified != "no"
assert proof.positive

# %% [markdown]
# A proof of convergence to a leader is a proof about equal lines. It does not say what unequal
# loads do to a proportional controller. That is what the run is for.
#
# ## Ample water, loads that move together
#
# Loads of a compute hall rise and fall together, because jobs span the hall. The generator has the
# statistics of a public day of a large machine; the seed makes it repeatable.

# %%
loads = generate_loads(n, until=2 * 3600.0, seed=1, maximum=np.linspace(90e3, 130e3, n))
names = ("proportional", "integral", "integral_ff", "pi", "pi_ff")
ample = {
    name: simulate_row(Row(network, loads, controller(name), until=2 * 3600.0, delay=5.0))
    for name in names
}


# %%
def table(runs):
    """Print what the runs are judged by, from the tenth minute on."""
    print("controller      RMS K  worst K  spread K  strokes/h  hottest °C")
    for name, done in runs.items():
        k = done.figures(since=600.0)
        print(
            f"{name:14} {k.rms:6.2f} {k.worst:8.2f} {k.spread:9.2f} {k.strokes_per_hour:10.1f}"
            f" {k.hottest_case - 273.15:11.1f}"
        )
    return {name: done.figures(since=600.0) for name, done in runs.items()}


figures = table(ample)
assert figures["pi_ff"].rms < figures["integral_ff"].rms < figures["proportional"].rms

# %%
figure, (top, bottom) = plt.subplots(
    2, 1, figsize=(9, 5), layout="constrained", sharex=True, height_ratios=(1, 2)
)
top.plot(loads.time / 60, loads.power / 1e3, lw=0.8, color="#767676")
top.set(ylabel="heat load [kW]", title="Loads of the eight lines")
for name in ("proportional", "integral_ff", "pi_ff"):
    done, (colour, dash) = ample[name], STYLE[name]
    off = done.supply - done.set_point[:, None]
    bottom.fill_between(done.time / 60, off.min(1), off.max(1), color=colour, alpha=0.25, lw=0)
    bottom.plot(done.time / 60, off.mean(1), dash, color=colour, label=name)
bottom.axhspan(-1, 1, color="#009e73", alpha=0.08)
bottom.text(1, 0.75, "±1 K", color="#767676")
bottom.set(xlabel="time [min]", ylabel="from set-point [K]")
bottom.set_title("Supply temperature: mean of the row, and its coolest to warmest line")
bottom.legend(loc="lower right", ncols=3)

# %% [markdown]
# With ample water a PI controller per line with feedforward of the measured IT power keeps the
# set-point best, if every line knows it. The distributed controller with the same feedforward is
# worse by hundredths of a kelvin, with half the valve travel and only line 1 told the set-point.
# Feedforward does it: the integral alone learns a swing that all lines share slowly, through line
# 1. The proportional consensus leaves an offset whenever the load is not the nominal one.
#
# ## Too little water
#
# Now the facility cannot serve everybody: the header loses pressure when many valves open, and the
# loads, unequal from line to line, are more than it was built for.

# %%
share = np.random.default_rng(1).permutation(np.linspace(40e3, 130e3, n)) * 1.4
steps = Loads(
    np.array([0.0, 600.0, 605.0, 3600.0]),
    np.array([np.full(n, 80e3), np.full(n, 80e3), share, share]),
)
short = {
    name: simulate_row(Row(network, steps, controller(name), until=3600.0, delay=5.0, shortage=3.0))
    for name in ("integral_ff", "pi_ff")
}
figures = table(short)

# %%
figure, (left, right) = plt.subplots(
    1, 2, figsize=(9, 3.6), layout="constrained", width_ratios=(3, 2), sharey=True
)
for k, (name, done) in enumerate(short.items()):
    colour, dash = STYLE[name]
    off = done.supply - done.set_point[:, None]
    left.plot(done.time / 60, off, dash, color=colour, lw=1)
    left.plot([], [], dash, color=colour, label=name)
    right.bar(np.arange(1, n + 1) + 0.4 * k - 0.2, off[-1], 0.4, color=colour, label=name)
left.set(xlabel="time [min]", ylabel="from set-point [K]", title="All eight lines")
right.set(xlabel="line", title="At the end")
right.axhline(0, color="#767676", lw=0.8)
left.legend(loc="upper left")
gain = {
    what: 1 - getattr(figures["integral_ff"], what) / getattr(figures["pi_ff"], what)
    for what in ("worst", "spread")
}
print(f"worst deviation {gain['worst']:.0%} lower, spread {gain['spread']:.0%} lower")
assert min(gain.values()) > 0.4

# %% [markdown]
# With a PI controller per line the lines with small loads keep their set-point, and those with
# large loads get what is left. The consensus shares the shortage: nobody is on the set-point, and
# nobody is far from it.
#
# ## The decision
#
# | the row | take |
# |---|---|
# | facility water is ample, every line knows its set-point | PI per line, with feedforward |
# | water can run short | the distributed controller with integral and feedforward |
# | only some lines are told the set-point | the same |
#
# Comparisons like these ship as scenarios, `posmas-fmi run cooling_common_mode` and
# `cooling_shortage`, with more controllers and a page of key figures.
#
# The sharing costs something: with ample water the distributed controller is worse than PI with
# feedforward by the figures of the first table. No run here is a proof: certificate P, C and T
# above are about the proportional form, `posmas-fmi design cooling_integral` has one of the
# integral form, and what is proved of each controller is said in
# `posmas_fmi.cooling.control.WHAT_IS_PROVED`.
