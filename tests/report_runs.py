"""Result folders for the tests of the report: model (1) of the paper simulated with numpy."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

A = np.array([[-10.18, 9.98], [10.3, -9.84]])
H = np.array([[0.698, -0.26], [0.682, -0.34]])
B = np.array([[0.7], [0.7]])
C = np.array([[0.7, -0.3], [0.1, 0.6]])
K = np.array([[-0.5725, -0.5786]])
E = np.array([[-0.1724, 3.7982], [3.7982, 3.0183]])
ARCS = [(2, 1), (3, 1), (4, 2), (1, 3), (2, 3), (1, 4)]
SCENARIO = """[scenario]
name = "paper-example-1"
until = 10.0
period = 0.005
seed = 1

[agent]
A = [[-10.18, 9.98], [10.3, -9.84]]
sec = ["1.2*u1 - 0.3*u1*abs(sin(u1))"]
sector = [0.9, 1.2]
"""


def sec(u: np.ndarray) -> np.ndarray:
    return 1.2 * u - 0.3 * u * np.abs(np.sin(u))


def _rate(t: float, x: np.ndarray, force: np.ndarray | float) -> np.ndarray:
    psi = 0.31 * x * t
    g = np.stack([x[..., 0] * np.sin(psi[..., 0]), x[..., 1] * np.cos(psi[..., 1])], axis=-1)
    return x @ A.T + g @ H.T + force


def _step(t: float, x: np.ndarray, force: np.ndarray | float, h: float) -> np.ndarray:
    k1 = _rate(t, x, force)
    k2 = _rate(t + h / 2, x + h / 2 * k1, force)
    k3 = _rate(t + h / 2, x + h / 2 * k2, force)
    k4 = _rate(t + h, x + h * k3, force)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def simulate(
    pinned_laplacian: np.ndarray,
    pinning: np.ndarray,
    gain: np.ndarray = K,
    until: float = 10.0,
    period: float = 0.005,
    phi: float = 10.0,
    seed: int = 1,
) -> dict[str, np.ndarray]:
    n, count = len(pinning), round(until / period) + 1
    x = np.random.default_rng(seed).uniform(0.0, 2.0, (n, 2))
    xhat, s = np.zeros((n, 2)), np.ones(2)
    out = {
        "time": period * np.arange(count),
        **{name: np.full((count, n, 2), np.nan) for name in ("x", "xhat", "y")},
        **{name: np.full((count, n, 1), np.nan) for name in ("u", "sec_u")},
        "s": np.full((count, 2), np.nan),
    }
    with np.errstate(all="ignore"):
        for k, t in enumerate(out["time"]):
            error = pinned_laplacian @ xhat - pinning[:, None] * s
            u = phi * error @ gain.T
            y = x @ C.T
            for name, value in (
                ("x", x), ("xhat", xhat), ("y", y), ("u", u), ("sec_u", sec(u)), ("s", s)
            ):  # fmt: skip
                out[name][k] = value
            force = sec(u) @ B.T
            x, xhat, s = (
                _step(t, x, force, period),
                _step(t, xhat, force + (y - xhat @ C.T) @ E.T, period),
                _step(t, s, 0.0, period),
            )
    return out


def laplacians(
    n: int, arcs: Sequence[tuple[int, int]], pinned: Sequence[int], sign: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """L + sign·D and sign·d for arcs between agents numbered from 1."""
    adjacency = np.zeros((n, n))
    for source, target in arcs:
        adjacency[target - 1, source - 1] = 1.0
    d = np.zeros(n)
    d[[k - 1 for k in pinned]] = sign
    return np.diag(adjacency.sum(1)) - adjacency + np.diag(d), d


def design_facts(**changes: Any) -> dict[str, Any]:
    facts = {
        "method": "contraction",
        "observer": "local",
        "protocol": "corrected",
        "phi": 10.0,
        "mu": 1.0,
        "K": K.tolist(),
        "E": E.tolist(),
        "certified": "conditional",
        "assumptions": [
            {
                "name": "lipschitz",
                "status": "contradicted",
                "detail": "declared 1; at t = 10, x1 = 4 the slope of g1 is 13.2",
            },
            {"name": "sector", "status": "verified", "detail": "sec(u)/u in [0.9, 1.2]"},
            {"name": "growth", "status": "verified", "detail": "|g_k| <= x_k"},
            {"name": "leader", "status": "declared", "detail": "s >= 0 for all t"},
        ],
        "rate": 0.254,
        "observer_rate": 1.99,
        "positive": True,
        "pinned": [2],
        "p_max": 5.0,
        "period": 0.005,
        "conditions": [
            {
                "name": "P: A - EC - |H| l >= 0 off the diagonal",
                "holds": True,
                "margin": 5.21,
                "proof": "interval arithmetic",
                "detail": "",
            },
            {
                "name": "P: A + phi m_h (Lp)_ii B K - |H| l >= 0 off the diagonal",
                "holds": True,
                "margin": 1.3e-3,
                "proof": "interval arithmetic",
                "detail": "largest (Lp)_ii = 2, agent 1",
            },
            {
                "name": "T: sampled controller, r < 1",
                "holds": True,
                "margin": 1.27e-3,
                "proof": "v > 0 with a rounding-error bound",
                "detail": "v0 = [0.71, 0.70]",
            },
        ],
        "baseline": {"rate": -0.13, "certified": "no", "detail": "A has the eigenvalue +0.130"},
        "sector": [0.9, 1.2],
    }
    return {**facts, **changes}


def write_run(
    folder: Path,
    signals: dict[str, np.ndarray],
    arcs: Sequence[tuple[int, int]],
    pinned: Sequence[int],
    names: Sequence[str] = (),
    verdict: str = "converged",
    design: dict[str, Any] | None = None,
    complete: int = 1,
    scenario: str = "paper-example-1",
    recorded: dict[str, np.ndarray] | None = None,
    **summary: Any,
) -> Path:
    """Write results.nc and the three JSON files of a run as the master does."""
    folder.mkdir(parents=True, exist_ok=True)
    n = signals["xhat"].shape[1]
    names = list(names) or [str(k + 1) for k in range(n)]
    dims = {"x": "state", "xhat": "state", "x_baseline": "state", "u": "input", "sec_u": "input"}
    weights = np.isin(np.arange(1, n + 1), list(pinned)).astype(float)
    variables: dict[str, Any] = {
        "s": (("time", "state"), signals["s"]),
        "pinning": ("agent", weights),
        "arc_from": ("arc", np.array([a - 1 for a, _ in arcs], dtype=np.int64)),
        "arc_to": ("arc", np.array([b - 1 for _, b in arcs], dtype=np.int64)),
        "arc_weight": ("arc", np.ones(len(arcs))),
    }
    for name, values in signals.items():
        if name not in ("time", "s"):
            variables[name] = (("time", "agent", dims.get(name, "output")), values)
    for name, values in (recorded or {}).items():
        variables[name] = (("time", "agent")[: values.ndim], values)
    dataset = xr.Dataset(
        variables,
        coords={"time": ("time", signals["time"], {"units": "s"}), "agent": ("agent", names)},
        attrs={
            "scenario": scenario,
            "period": float(signals["time"][1]) if len(signals["time"]) > 1 else 0.005,
            "created_by": "posmas-fmi 0.1.0",
            "complete": complete,
        },
    )
    dataset.to_netcdf(folder / "results.nc", engine="h5netcdf")
    (folder / "design.json").write_text(json.dumps(design or design_facts()), encoding="utf-8")
    (folder / "summary.json").write_text(
        json.dumps(_summary(signals, names, verdict) | summary), encoding="utf-8"
    )
    (folder / "manifest.json").write_text(
        json.dumps(
            {
                "versions": {"posmas-fmi": "0.1.0", "python": "3.11.2", "numpy": "2.4.6"},
                "seed": 1,
                "command": "posmas-fmi run paper_example_1",
                "platform": "Linux x86_64",
                "fmus": {"positive_agent.fmu": "sha256:" + 64 * "a"},
                "inputs": {"paper_example_1.toml": "sha256:" + 64 * "b"},
                "scenario": SCENARIO,
            }
        ),
        encoding="utf-8",
    )
    return folder


def _summary(signals: dict[str, np.ndarray], names: Sequence[str], verdict: str) -> dict[str, Any]:
    with np.errstate(all="ignore"):
        shown = signals.get("x", signals["xhat"])
        tracking = np.abs(shown - signals["s"][:, None, :])
        estimation = np.abs(signals["x"] - signals["xhat"])[-1:] if "x" in signals else None
    final = tracking[-1].max(axis=-1) if len(tracking) else np.full(len(names), np.nan)
    return {
        "verdict": verdict,
        "agents": [
            {
                "name": name,
                "status": "lost" if not np.isfinite(error) else verdict,
                "final_error": float(error),
            }
            for name, error in zip(names, final, strict=True)
        ],
        "tracking_error_final": float(final.max()),
        "estimation_error_final": None if estimation is None else float(estimation.max()),
        "min_state": None if "x" not in signals else float(np.fmin.reduce(signals["x"], axis=None)),
        "wall_s": 0.91,
        "steps": len(signals["time"]) - 1,
    }


def example_1(folder: Path, names: Sequence[str] = (), **changes: Any) -> Path:
    """Example 1 with the corrected protocol: converges."""
    lp, d = laplacians(4, ARCS, [2])
    signals = simulate(lp, d)
    signals["x_baseline"] = simulate(lp, d, gain=0 * K)["x"]
    return write_run(folder, signals, ARCS, [2], names=names, **changes)


def example_1_without_x(folder: Path) -> Path:
    lp, d = laplacians(4, ARCS, [2])
    signals = simulate(lp, d)
    del signals["x"], signals["sec_u"]
    return write_run(folder, signals, ARCS, [2])


def example_1_printed(folder: Path) -> Path:
    """Example 1 with the printed sign of the pinning: diverges."""
    lp, d = laplacians(4, ARCS, [2], sign=-1.0)
    failed = {
        "name": "C: closed loop contracts",
        "holds": False,
        "margin": -7.1,
        "proof": "K d < 0: positive feedback at the pinned agent",
        "detail": "",
    }
    facts = design_facts(
        method="gains", protocol="printed", certified="no", rate=None, positive=False
    )
    facts["conditions"] = [*facts["conditions"][:1], failed]
    gain = np.array([[-0.4410, -0.4410]])
    signals = simulate(lp, d, gain=gain)
    return write_run(
        folder, signals, ARCS, [2], verdict="diverged", design=facts,
        scenario="paper-example-1-printed",
    )  # fmt: skip


def cut_off(folder: Path, steps: int = 400) -> Path:
    """Example 1 stopped early: rows allocated but never written, no summary.json."""
    lp, d = laplacians(4, ARCS, [2])
    signals = simulate(lp, d)
    for name, values in signals.items():
        values[steps:] = 0.0 if name == "time" else np.nan
    write_run(folder, signals, ARCS, [2], complete=0)
    (folder / "summary.json").unlink()
    return folder


def with_faults(folder: Path, **changes: Any) -> Path:
    """Example 1 with a fault, an FMU that failed, delays, and variables recorded besides."""
    lp, d = laplacians(4, ARCS, [2])
    signals = simulate(lp, d)
    time = signals["time"]
    given = {
        "recorded": {
            "heat_load": 5e4 * (1 + 0.1 * np.sin(time[:, None] + np.arange(4))),
            "facility.T_supply": 305.15 + 0.2 * np.sin(0.5 * time),
        },
        "coverage": [
            {"what": "delay of messages", "covered": True, "why": "certificate D: held"},
            {"what": "rounded messages", "covered": False, "why": "a bounded disturbance"},
        ],
        "faults": [
            {
                "kind": "sensor bias",
                "agent": "3",
                "from": 2.0,
                "until": 4.0,
                "detail": "an added value",
                "covered": "not covered, but bounded",
            },
            {
                "kind": "leader lost",
                "agent": "all",
                "from": 7.0,
                "until": None,
                "detail": "the last state heard is held",
                "covered": "covered by certificate D as a delay",
            },
        ],
        "incidents": [
            {
                "agent": "2",
                "time": 5.125,
                "verdict": "killed by signal 9",
                "action": "frozen: its last outputs are held",
            }
        ],
        **changes,
    }
    return write_run(folder, signals, ARCS, [2], **given)


def single_agent(folder: Path) -> Path:
    lp, d = laplacians(1, [], [1])
    return write_run(folder, simulate(lp, d, until=4.0), [], [1], names=["cooling line"])


def many_agents(folder: Path, n: int = 200) -> Path:
    """A ring with chords, every tenth agent pinned."""
    rng = np.random.default_rng(3)
    arcs = {(k, k % n + 1) for k in range(1, n + 1)}
    while len(arcs) < 2 * n:
        a, b = (int(v) for v in rng.integers(1, n + 1, 2))
        if a != b:
            arcs.add((a, b))
    pinned = list(range(1, n + 1, 10))
    lp, d = laplacians(n, sorted(arcs), pinned)
    signals = simulate(lp, d, until=6.0, phi=3.0)
    return write_run(
        folder, signals, sorted(arcs), pinned,
        design=design_facts(pinned=pinned, p_max=14.2), scenario="ring-200",
    )  # fmt: skip


RUNS: dict[str, Callable[[Path], Path]] = {
    "example_1": example_1,
    "example_1_without_x": example_1_without_x,
    "example_1_printed": example_1_printed,
    "cut_off": cut_off,
    "single_agent": single_agent,
    "with_faults": with_faults,
    "many_agents": many_agents,
}
