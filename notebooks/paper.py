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
# # The paper's examples, and its errata
#
# Zaman, Birk and Atta let positive agents agree with a leader that only pinned agents hear.
# This notebook runs their first example as printed, shows why it diverges, repairs it, and reads
# the proof of the repaired loop. Numbers in parentheses are equations of the paper, errata are
# counted as on the page *Theory*.

# %%
from pathlib import Path
from tempfile import TemporaryDirectory

import attrs
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

from posmas_fmi import load, run
from posmas_fmi.design import certify, design
from posmas_fmi.design.ledger import ledger
from posmas_fmi.design.paper_examples import EXAMPLE_1, EXAMPLE_2

BLUE, ORANGE, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#767676"
plt.rcParams.update({"figure.dpi": 110, "axes.spines.top": False, "axes.spines.right": False})
workspace = TemporaryDirectory()
out = Path(workspace.name)

# %% [markdown]
# ## The ledger
#
# Every number and condition that the paper prints was computed again. Each line of the ledger has
# a verdict and a proof that can be checked by hand or in exact arithmetic.

# %%
entries = ledger()
for verdict in ("reproduced", "rounded", "contradicted", "infeasible"):
    print(f"{sum(e.verdict == verdict for e in entries):3} {verdict}")

# %% [markdown]
# The numbers are mostly right. What is wrong are signs and conditions, and those decide:

# %%
for e in entries:
    if e.erratum in (1, 3, 5) and e.verdict in ("contradicted", "infeasible"):
        print(f"erratum {e.erratum}: {e.item}\n    printed:  {e.printed}\n    proof:    {e.proof}")

# %% [markdown]
# ## As printed it diverges, with one sign changed it converges
#
# The same agents as FMUs, the same gains, the same start. In (6) the pinned agent is pushed *away*
# from the leader: K is negative, so `−φ d_i K (x̂_i − s)` is a positive feedback. The corrected
# protocol has a plus there.

# %%
printed = load("paper_example_1_printed")
corrected = attrs.evolve(printed, design=attrs.evolve(printed.design, protocol="corrected"))
results = {}
for name, scenario in {"printed": printed, "corrected": corrected}.items():
    done = run(scenario, out / name, report=False)
    results[name] = xr.load_dataset(out / name / "results.nc", engine="h5netcdf")
    print(f"{name:10} {done.summary['verdict']:10} lowest state {done.summary['min_state']:.3g}")


# %%
def error(results):
    """Largest distance of any agent from the leader."""
    return np.abs(results.x - results.s).max(["agent", "state"])


figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
for name, colour, dash in (("printed", ORANGE, "--"), ("corrected", BLUE, "-")):
    distance = error(results[name])
    left.semilogy(distance.time, distance, dash, color=colour, label=f"(6) {name}")
left.set(xlabel="time [s]", ylabel="largest |x − s|", title="Distance from the leader")
left.set_ylim(1e-9, 1e6)
left.legend()
first = results["printed"].x.isel(state=0).where(results["printed"].time < 1.8, drop=True)
for agent in first.agent.values:
    right.plot(first.time, first.sel(agent=agent), label=f"agent {agent}")
right.axhline(0, color=GREY, lw=0.8)
right.set(xlabel="time [s]", ylabel="$x_1$", title="As printed: states turn negative")
right.set_ylim(-20, 20)
right.legend(ncols=2, fontsize="small")

# %% [markdown]
# ### Why: the spectrum
#
# With a linear sector and without g the network is `I ⊗ A + φ (L ± D) ⊗ BK`. `L + D` is a
# non-singular M-matrix, `L − D` is not: one eigenvalue of the printed loop lies to the right of the
# imaginary axis.

# %%
scenario = load("paper_example_1")
L = scenario.network.laplacian.toarray()
D = np.diag(scenario.network.pinning)
A, BK = np.array(EXAMPLE_1.A), np.array(EXAMPLE_1.B) @ np.array(EXAMPLE_1.designs[1].K)
spectra = {
    name: np.linalg.eigvals(np.kron(np.eye(4), A) + EXAMPLE_1.phi * np.kron(matrix, BK))
    for name, matrix in {"printed, L − D": L - D, "corrected, L + D": L + D}.items()
}
figure, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
for (name, values), mark, colour in zip(spectra.items(), "x+", (ORANGE, BLUE), strict=True):
    axes.plot(values.real, values.imag, mark, ms=9, mew=2, color=colour, label=name)
    print(f"{name}: largest real part {values.real.max():+.3f} 1/s")
axes.axvline(0, color=GREY, lw=0.8)
axes.axvspan(0, 4, color=ORANGE, alpha=0.08)
axes.text(0.15, axes.get_ylim()[1] * 0.8, "unstable", color=ORANGE)
axes.set_title("Eigenvalues of the linear network")
axes.set(xlabel="real part [1/s]", ylabel="imaginary part [1/s]", xlim=(-27, 4))
axes.legend(loc="lower left")
assert spectra["printed, L − D"].real.max() > 0 > spectra["corrected, L + D"].real.max()

# %% [markdown]
# ## A proof instead of a run
#
# That the corrected loop converged once is evidence. A certificate is a proof: for every start,
# every nonlinearity in the sector, and for the loop that samples every 5 ms. First the paper's own
# gains with the corrected sign, then gains of this package.

# %%
gains = EXAMPLE_1.designs[1]
h = scenario.clock.h
paper = certify(scenario.agent, scenario.network, gains.K, gains.E, corrected.design, h)
ours = design(scenario.agent, scenario.network, scenario.design, h)
for name, made in {"paper's gains": paper, "contraction design": ours}.items():
    proof = made.certificate
    rate = "no rate" if proof.rate is None else f"rate {proof.rate:.3f} 1/s"
    print(f"{name}: certified {proof.certified}, positive {proof.positive}, {rate}")
    for condition in proof.conditions:
        print(f"    {'holds' if condition.holds else 'FAILS'}  {condition.name}")

# %% [markdown]
# ### On which condition
#
# The proof takes the slope of g as at most 1, as the paper declares. That is contradicted by the
# paper's own g, so the certificate says *conditional* and names the point (erratum 9). With a g
# that has the bound it is a proof without condition.

# %%
for assumption in ours.certificate.open_assumptions:
    print(f"{assumption.name}: {assumption.status}: {assumption.detail}")
tanh = load("paper_example_1_tanh")
proved = run(tanh, out / "tanh", report=False)
proof = proved.design.certificate
print(f"with g = tanh: certified {proof.certified}, rate {proof.rate:.3f} 1/s")

# %%
trace = xr.load_dataset(out / "tanh" / "results.nc", engine="h5netcdf")
distance, alone = error(trace), np.abs(trace.x_baseline - trace.s).max(["agent", "state"])
figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
axes.semilogy(alone.time, alone, ":", color=GREY, label="without control, K = 0")
axes.semilogy(distance.time, distance, color=BLUE, label="with the designed gains")
proved_line = float(distance[0]) * np.exp(-proof.rate * distance.time)
axes.semilogy(distance.time, proved_line, "--", color=GREEN, label="slope of the proved rate")
axes.set(xlabel="time [s]", ylabel="largest |x − s|", title="Run and proof, g = tanh")
axes.legend()
assert proof.certified == "yes"
assert error(trace)[-1] < 1e-6

# %% [markdown]
# The run is faster than the proved rate, as it must be in the long run: the proof holds for the
# worst nonlinearity of the sector and the worst digraph with this p_max, not for this one.
#
# ## The second example loses positivity
#
# Condition 1 of Theorem 1 fails for the printed gain of Example 2 (erratum 5). A start shows it:
# all at zero except one, at an agent with four neighbours. Signs are the corrected ones here.

# %%
ex = EXAMPLE_2
second = load("paper_example_2")
busiest = int(np.argmax(ex.network(1).in_degree))
start = np.zeros((9, 2))
start[busiest] = [2.0, 0.0]
settings = attrs.evolve(
    second.design,
    method="gains",
    K=np.array(ex.designs[1].K),
    E=np.array(ex.designs[1].E),
    phi=ex.phi,
)
with_paper_gain = attrs.evolve(second, design=settings)
lowest = {}
for name, scenario in {"paper's gain": with_paper_gain, "contraction design": second}.items():
    started = attrs.evolve(scenario, x0=start, xhat0=start, s0=np.zeros(2))
    run(started, out / name, report=False)
    lowest[name] = xr.load_dataset(out / name / "results.nc", engine="h5netcdf").x.min("agent")

figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
for (name, values), colour, dash in zip(lowest.items(), (ORANGE, BLUE), ("--", "-"), strict=True):
    values = values.min("state").where(values.time < 0.4, drop=True)
    axes.plot(values.time, values, dash, color=colour, label=name)
axes.axhline(0, color=GREY, lw=0.8)
axes.set(xlabel="time [s]", ylabel="lowest state of all agents", title="Example 2")
axes.legend()
assert lowest["paper's gain"].min() < -0.1
assert lowest["contraction design"].min() > -1e-9

# %% [markdown]
# A negative state is no detail here: a temperature above the facility supply or a concentration
# cannot be negative, so the model, and every proof that uses its positivity, ends there.

# %%
workspace.cleanup()
