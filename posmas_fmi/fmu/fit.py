"""Model (1) from an FMU: x' = A x + H g(t, x) + B sec(u), y = C x, fitted and judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.agent import Agent, state_names
from posmas_fmi.errors import AgentError, FmuError, InputError
from posmas_fmi.expression import Array, VectorFunction
from posmas_fmi.fmu.differences import jacobian, steps_for
from posmas_fmi.fmu.evaluation import (
    Equations,
    Interface,
    Signals,
    Values,
    bring_to,
    check_values,
    default_step,
    equations,
    open_fmu,
    signals,
)
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.linearise import (
    Linearisation,
    MetzlerReport,
    linearise_open,
    metzler_report,
)

_NEGLIGIBLE = 1e-8  # of the largest derivative on the region: a term below is left out
_GRID = 33  # points per input for its sector
_DEGREE_OF_SEC = 5
_JACOBIANS = 64  # samples at which slopes are taken
_REACH = 0.1  # of the size of a variable: the region where none is given
_NO_USE = 0.5  # relative residual from which on a model is of no use

Region = Mapping[str, tuple[float, float]]


@attrs.frozen(eq=False)
class FittedAgent:
    """Model (1) of an FMU in deviations from an operating point, and how good it is.

    The protocol's quantities are ``x = (x_FMU - x0)``, ``u = (u_FMU - u0) / input_scale`` and
    ``y = y_FMU - y0``; `to_toml` writes that into the ports.

    Attributes
    ----------
    agent : Agent
    g, sec : tuple of str
        Its expressions as text.
    linearisation : Linearisation
    metzler : MetzlerReport
        Of the fitted A before its negative off-diagonal entries were moved into g.
    sector : (p, 2) ndarray
        Least and largest ``sec_k(u)/u`` among the samples, per input.
    lipschitz : (m, m) ndarray
        Largest ``|∂f/∂x - A|`` among the samples, entrywise [1/s]: an estimate from below of
        ``|H|ℓ``, not a proof; NaN if nothing was sampled.
    residual : float
        Root mean square of f - model over fresh samples, relative to that of f.
    residual_max : float
        Largest component of f - model there, in units of x per second.
    samples : int
        Number of fresh samples; 0 if the nonlinearity could not be sampled.
    input_scale : (p,) ndarray
        -1 for an input that acts downwards, so that B ≥ 0; else 1.
    path : Path
        The FMU.
    values : mapping
        Parameters and start values that it was given.
    notes : tuple of str
    """

    agent: Agent
    g: tuple[str, ...]
    sec: tuple[str, ...]
    linearisation: Linearisation
    metzler: MetzlerReport
    sector: Array
    lipschitz: Array
    residual: float
    residual_max: float
    samples: int
    input_scale: Array
    path: Path
    values: Values
    notes: tuple[str, ...]

    @property
    def useful(self) -> bool:
        """Whether linearisation and fit are: a relative residual below one half, where sampled."""
        return self.linearisation.useful and not self.residual >= _NO_USE

    def to_dict(self) -> dict[str, Any]:
        """Return everything as lists and numbers, for JSON."""
        agent = self.agent
        return {
            **{name: getattr(agent, name).tolist() for name in "AHBC"},
            "g": list(self.g),
            "sec": list(self.sec),
            "sector": list(agent.sector),
            "sector_sampled": self.sector.tolist(),
            "lipschitz": None if agent.lipschitz is None else np.ravel(agent.lipschitz).tolist(),
            "slopes_sampled": _known(self.lipschitz),
            "metzler": self.metzler.to_dict(),
            "residual": None if np.isnan(self.residual) else self.residual,
            "residual_max": None if np.isnan(self.residual_max) else self.residual_max,
            "samples": self.samples,
            "region": {name: list(pair) for name, pair in agent.region.items()},
            "assumptions": [attrs.asdict(a) for a in agent.assumptions()],
            "input_scale": self.input_scale.tolist(),
            "linearisation": self.linearisation.to_dict(),
            "useful": self.useful,
            "notes": list(self.notes),
            "toml": self.to_toml(),
        }

    def to_toml(self) -> str:
        """Return the ``[agent]`` and ``[plant]`` sections of a scenario.

        The path of the FMU is its file name: put the FMU beside the scenario.
        """
        from posmas_fmi.fmu.agent_toml import agent_toml

        return agent_toml(self)


def fit_agent(
    path: str | Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    region: Region | None = None,
    at: float = 0.0,
    *,
    g: Sequence[str] | None = None,
    sec: Sequence[str] | None = None,
    values: Values | None = None,
    states: Sequence[str] | None = None,
    interface: Interface | None = None,
    degree: int = 2,
    samples: int = 256,
    seed: int = 0,
) -> FittedAgent:
    """Fit model (1) to an FMU on a region around an operating point.

    B and sec come from each input moved alone over its range; A, H and the coefficients of g from
    least squares over samples of the right-hand side. What keeps A from being Metzler is moved
    into g, so that the certificate pays for it through ℓ and the model stays the same.

    Parameters
    ----------
    path : path-like
    inputs, outputs : sequence of str
        Variables or elements (``u[1]``).
    region : mapping, optional
        Ranges of the deviations from the operating point: ``x`` and ``u`` for all states and
        inputs, or ``x1``, ``u1``, … for single ones; ``t`` in seconds (default: `at` alone).
        Without it a tenth of each variable's size either side, and a note that says so.
    at : float
        Time of the operating point [s].
    g : sequence of str, optional
        Candidates in ``t, x1, …, xm`` (deviations), at most m; H is fitted. Without them g is a
        polynomial and H = 1.
    sec : sequence of str, optional
        One expression in ``u1``, … per input (deviations); B is fitted. Without them sec is a
        polynomial with slope 1 at the operating point, or near it.
    values, states, interface
        As in `posmas_fmi.fmu.linearise.linearise`.
    degree : int
        Of the polynomial g.
    samples : int
        For the fit; as many fresh ones for the residual.
    seed : int
        Of the samples.

    Returns
    -------
    FittedAgent

    Raises
    ------
    InputError
        If a name or the region is wrong.
    AgentError
        If the FMU is no system of the form (1): an input that acts upwards on one state and
        downwards on another, a direct path from input to output, states without names.
    FmuError
        If the FMU fails.

    Examples
    --------
    >>> from posmas_fmi.fmu.build import agent_fmu
    >>> true_g = VectorFunction.parse(["0"], ["t", "x1"])
    >>> path = agent_fmu(true_g, VectorFunction.parse(["u1"], ["u1"]), 1, 1, 1)
    >>> made = fit_agent(path, ["u"], ["y"], {"x": (0, 2), "u": (-1, 1)}, values={"A": [[-2.0]]})
    >>> made.agent.A.round(9), made.metzler.metzler, bool(made.residual < 1e-9)
    (array([[-2.]]), True, True)
    """
    values = dict(values or {})
    with open_fmu(path, interface) as file:
        names = signals(file, inputs, outputs, states)
        check_values(file, values)
        return fit_open(
            *(file, names, region, at, values),
            g=g,
            sec=sec,
            degree=degree,
            samples=samples,
            seed=seed,
        )


def fit_open(
    file: FmuFile,
    names: Signals,
    region: Region | None,
    at: float,
    values: Values,
    *,
    g: Sequence[str] | None = None,
    sec: Sequence[str] | None = None,
    degree: int = 2,
    samples: int = 256,
    seed: int = 0,
) -> FittedAgent:
    """Fit model (1) to an FMU that is loaded; see `fit_agent`."""
    made, f = _linearised(file, names, at, values)
    notes = []
    if region is None:
        region = _around(file, made)
        notes.append(
            "no region was given: a tenth of each variable's size either side was taken; "
            "give the range where the plant works"
        )
    box = _Box.of(region, len(names.states), len(names.inputs), at)
    fit = _Fit(made, f, box, samples, seed, notes)
    return fit.run(g, sec, degree, file.path, values)


def _linearised(
    file: FmuFile, names: Signals, at: float, values: Values
) -> tuple[Linearisation, Equations | None]:
    """Linearise, and return the equations if they can be evaluated."""
    made = linearise_open(file, names, at, values, None)
    where = file.path.name
    if not made.named or made.dt:
        raise AgentError(
            "expected named states of a continuous system (give states that can be read and set)",
            where,
        )
    if not names.inputs or not names.states:
        raise AgentError("expected at least one state and one input", where)
    significant = max(made.error or 0.0, 1e-9 * float(np.abs(made.C).max(initial=1.0)))
    if np.abs(made.D).max(initial=0.0) > significant:
        raise AgentError(
            f"expected y = C x: an input acts on an output directly (D = {made.D.tolist()}); "
            "choose outputs that are states or functions of them",
            where,
        )
    instance = file.instantiate("fit")
    bring_to(instance, at, values, default_step(file))
    for way in equations(file, names, values, instance):
        try:
            f = way()
            f(at, made.x0, made.u0)
        except FmuError:
            continue
        return made, f
    return made, None


def _around(file: FmuFile, made: Linearisation) -> dict[str, tuple[float, float]]:
    """Take a region around the operating point: a tenth of the larger of value and nominal."""
    found = {}
    for letter, names, values in (("x", made.states, made.x0), ("u", made.inputs, made.u0)):
        for k, (name, value) in enumerate(zip(names, values, strict=True)):
            size = _REACH * max(abs(float(value)), abs(file.variable(name).nominal))
            found[f"{letter}{k + 1}"] = (-size, size)
    return found


@attrs.frozen(eq=False)
class _Box:
    """The region in deviations."""

    t: tuple[float, float]
    x: Array  # (m, 2)
    u: Array  # (p, 2)

    @classmethod
    def of(cls, region: Region, m: int, p: int, at: float) -> _Box:
        known = {"t", "x", "u", *_names("x", m), *_names("u", p)}
        for name, bounds in region.items():
            if name not in known:
                raise InputError(f"expected one of {', '.join(sorted(known))}", f"region.{name}")
            low, high = (float(bound) for bound in bounds)
            if not (np.isfinite(low) and np.isfinite(high) and low <= high):
                raise InputError(
                    f"expected low <= high, both finite (got {bounds})", f"region.{name}"
                )
        return cls(
            region.get("t", (at, at)),
            np.array([cls._range(region, "x", k) for k in range(m)]),
            np.array([cls._range(region, "u", k) for k in range(p)]),
        )

    @staticmethod
    def _range(region: Region, letter: str, k: int) -> tuple[float, float]:
        for name in (f"{letter}{k + 1}", letter):
            if name in region:
                return region[name]
        raise InputError(f"expected a range for {letter}{k + 1}", "region")

    def draw(self, count: int, seed: int) -> tuple[Array, Array, Array]:
        """Return times (n,), states (n, m) and inputs (n, p), evenly spread (Sobol)."""
        from scipy.stats import qmc

        ranges = np.vstack([self.t, self.x, self.u]).astype(float)
        sobol = qmc.Sobol(len(ranges), rng=np.random.default_rng(seed))
        points = sobol.random_base2(int(np.ceil(np.log2(max(count, 2)))))
        points = ranges[:, 0] + points * (ranges[:, 1] - ranges[:, 0])
        m = len(self.x)
        return points[:, 0], points[:, 1 : m + 1], points[:, m + 1 :]


@attrs.frozen(eq=False)
class _Input:
    """One input: its column of B, sec as text, and its sector among the samples."""

    column: Array
    text: str
    sector: tuple[float, float]


@attrs.frozen(eq=False)
class _Fit:
    """The steps of the fit over one FMU."""

    made: Linearisation
    f: Equations | None
    box: _Box
    samples: int
    seed: int
    notes: list[str] = attrs.field(factory=list)

    def run(
        self,
        candidates: Sequence[str] | None,
        shapes: Sequence[str] | None,
        degree: int,
        path: Path,
        values: Values,
    ) -> FittedAgent:
        made = self.made
        p = made.B.shape[1]
        signs = self.signs()
        if self.f is None:
            self.notes.append(
                "the FMU does not tell its derivatives: the nonlinearity was not sampled"
            )
        if shapes is not None and len(shapes) != p:
            raise InputError(f"expected {p} expressions, one per input (got {len(shapes)})", "sec")
        inputs = [self.input(k, signs[k], shapes[k] if shapes else None) for k in range(p)]
        B = _digits(np.column_stack([one.column for one in inputs]))
        A, H, texts = self.nonlinearity(candidates, degree)
        report = metzler_report(A, B, self.small(A))
        A, H, texts = self.positive(A, H, texts, report)
        lipschitz = self.slopes(A)
        agent = self.agent(A, H, B, texts, inputs, candidates is None, lipschitz)
        residual, largest, count = self.residual(agent, signs)
        return FittedAgent(
            agent=agent,
            g=tuple(texts),
            sec=tuple(one.text for one in inputs),
            linearisation=made,
            metzler=report,
            sector=np.array([one.sector for one in inputs]),
            lipschitz=lipschitz,
            residual=residual,
            residual_max=largest,
            samples=count,
            input_scale=signs,
            path=path,
            values=values,
            notes=tuple(self.notes),
        )

    def small(self, M: Array) -> float:
        """Size below which an entry of M is its error."""
        return max(self.made.error or 0.0, 1e-9 * float(np.abs(M).max(initial=0.0)))

    # ---- inputs -----------------------------------------------------------------------------

    def signs(self) -> Array:
        """-1 where an input acts downwards on every state it acts on."""
        B = self.made.B
        small = self.small(B)
        signs = np.ones(B.shape[1])
        for k, column in enumerate(B.T):
            if (column < -small).any():
                if (column > small).any():
                    raise AgentError(
                        f"expected B >= 0: {self.made.inputs[k]!r} acts upwards on one state and "
                        f"downwards on another ({column.tolist()})",
                        "B",
                    )
                signs[k] = -1.0
                self.notes.append(f"{self.made.inputs[k]!r} acts downwards: its port is negated")
        return signs

    def input(self, k: int, sign: float, shape: str | None) -> _Input:
        """Move one input alone, and see along one column of B what it does."""
        made, name = self.made, f"u{k + 1}"
        slope = self.clipped(made.B[:, k] * sign)
        if self.f is None:
            return _Input(slope, name, (1.0, 1.0))
        u, effect = self.effect(k, sign)
        if shape is not None:
            known = VectorFunction.parse([shape], [name], f"sec[{k}]").numpy()(u)[:, 0]
            column = self.clipped(effect.T @ known / (known @ known or 1.0))
            return _Input(column, shape, _sector(effect, column, u))
        column = slope
        if not column.any():  # no slope here: the direction in which it acts at all
            column = self.clipped(effect[int(np.argmax(np.abs(effect).sum(axis=1)))])
        if not column.any():
            return _Input(column, name, (1.0, 1.0))
        powers = np.arange(1, _DEGREE_OF_SEC + 1)
        reach = float(np.abs(u).max())
        along = effect @ column / (column @ column)
        weights = np.linalg.lstsq((u / reach)[:, None] ** powers, along, rcond=None)[0]
        weights[np.abs(weights) < 1e-7 * np.abs(along).max()] = 0.0
        weights = _digits(weights / reach**powers)
        if not weights[1:].any():  # linear
            return _Input(column * float(weights[0]), name, (1.0, 1.0))
        terms = [(w, name if n == 1 else f"{name}**{n}") for n, w in enumerate(weights, 1)]
        return _Input(column, _sum(terms), _sector(effect, column, u))

    def effect(self, k: int, sign: float) -> tuple[Array, Array]:
        """Return deviations of one input, (n,), and what each adds to the derivatives, (n, m)."""
        assert self.f is not None
        made, (low, high) = self.made, self.box.u[k]
        if not low < high:
            raise InputError(f"expected low < high (got {low}, {high})", f"region.u{k + 1}")
        u = np.linspace(low, high, _GRID)
        u = u[np.abs(u) > 1e-9 * (high - low)]
        rest = self.f(made.at, made.x0, made.u0)[0]
        rows = []
        for value in u:
            moved = made.u0.copy()
            moved[k] += sign * value
            rows.append(self.f(made.at, made.x0, moved)[0] - rest)
        return u, np.array(rows)

    def clipped(self, column: Array) -> Array:
        """Take away what is within the error, and what is below zero."""
        return np.where(np.abs(column) <= self.small(column), 0.0, column.clip(0))

    # ---- states -----------------------------------------------------------------------------

    def nonlinearity(
        self, candidates: Sequence[str] | None, degree: int
    ) -> tuple[Array, Array, list[str]]:
        """Return A, H and the texts of g, fitted with the inputs at their operating point."""
        m = len(self.made.x0)
        variables = state_names(m)
        if self.f is None:
            return _digits(self.made.A), np.zeros((m, m)), ["0"] * m
        if candidates is not None and len(candidates) > m:
            raise InputError(f"expected at most {m} candidates (got {len(candidates)})", "g")
        terms = ["1", *_monomials(variables[1:], degree)] if candidates is None else [*candidates]
        t, x, u = self.box.draw(self.samples, self.seed)
        F = self.right_hand_side(t, x, 0 * u, np.ones(u.shape[1]))
        values = VectorFunction.parse(terms, variables, "g").numpy()(t, *x.T)
        features = np.column_stack([x, values])
        size = np.abs(features).max(axis=0)
        size[size == 0] = 1.0
        solution, _, rank, _ = np.linalg.lstsq(features / size, F, rcond=1e-12)
        if rank < features.shape[1]:
            self.notes.append("terms of the fit cannot be told apart on this region; widen it")
        solution[np.abs(solution) < _NEGLIGIBLE * float(np.abs(F).max(initial=0.0))] = 0.0
        coefficients = _digits((solution / size[:, None]).T)  # one row per state
        A = coefficients[:, :m]
        if candidates is not None:
            H = np.zeros((m, m))
            H[:, : len(terms)] = coefficients[:, m:]
            return A, H, [*terms, *["0"] * (m - len(terms))]
        if coefficients[:, m].any():
            self.notes.append(
                f"the operating point is no equilibrium: g holds its drift {coefficients[:, m]}"
            )
        texts = [_sum(list(zip(row[m:], terms, strict=True))) for row in coefficients]
        return A, np.eye(m), texts

    def right_hand_side(self, t: Array, x: Array, u: Array, signs: Array) -> Array:
        assert self.f is not None
        made = self.made
        rows = zip(t, x, u, strict=True)
        return np.array([self.f(s, made.x0 + z, made.u0 + signs * v)[0] for s, z, v in rows])

    def positive(
        self, A: Array, H: Array, texts: list[str], report: MetzlerReport
    ) -> tuple[Array, Array, list[str]]:
        """Move what keeps A from being Metzler into g."""
        m = len(A)
        if report.metzler:
            return report.nearest, H, texts
        where = ", ".join(f"({i}, {j}): {v:.4g}" for i, j, v in report.negative)
        if not (np.eye(m) == H).all() and H.any():
            raise AgentError(
                f"expected a Metzler A beside the given g; negative off the diagonal: {where}. "
                "Leave g out: then these entries become a part of it",
                "A",
            )
        self.notes.append(f"A is not Metzler, its negative entries went into g: {where}")
        excess = A - report.nearest
        names = _names("x", m)
        moved = [
            _sum([(1.0, f"({text})"), *zip(excess[i], names, strict=True)])
            if excess[i].any()
            else text
            for i, text in enumerate(texts)
        ]
        return report.nearest, np.eye(m), moved

    def slopes(self, A: Array) -> Array:
        """Largest ``|∂f/∂x - A|`` among samples."""
        m = len(A)
        if self.f is None:
            return np.full((m, m), np.nan)
        f, made = self.f, self.made
        t, x, _ = self.box.draw(_JACOBIANS, self.seed + 1)
        nominal = np.maximum(np.abs(self.box.x).max(axis=1), 1e-6)
        worst = np.zeros((m, m))
        for time, z in zip(t, x, strict=True):
            at = made.x0 + z
            slope = jacobian(
                lambda a, time=time: f(time, a, made.u0)[0],  # type: ignore[misc]
                at,
                steps_for(z, nominal),
            ).value
            worst = np.maximum(worst, np.abs(slope - A))
        floor = 1e-8 * max(1.0, float(np.abs(A).max()))
        worst[worst < floor] = 0.0
        return worst

    # ---- the result -------------------------------------------------------------------------

    def agent(
        self,
        A: Array,
        H: Array,
        B: Array,
        texts: list[str],
        inputs: list[_Input],
        unit: bool,
        lipschitz: Array,
    ) -> Agent:
        m, p = B.shape
        made = self.made
        region = {"t": self.box.t}
        region |= {n: _pair(r) for n, r in zip(_names("x", m), self.box.x, strict=True)}
        region |= {n: _pair(r) for n, r in zip(_names("u", p), self.box.u, strict=True)}
        names = _names("u", p)
        low = min(one.sector[0] for one in inputs)
        high = max(one.sector[1] for one in inputs)
        agent = Agent(
            A=A,
            H=H,
            B=B,
            C=_digits(made.C),
            g=VectorFunction.parse(texts, state_names(m), "g"),
            sec=VectorFunction.parse([one.text for one in inputs], names, "sec"),
            sector=(max(low, 0.0), max(high, 0.0)),
            region=region,
        )
        if low < 0:
            self.notes.append(f"sec leaves every sector: sec(u)/u = {low:.4g} somewhere")
        # the fitted sec must lie in the sector as well, so that its bound can be verified
        if agent.sector_bound:
            low = min(low, *(r.low for r in agent.sector_bound))
            high = max(high, *(r.high for r in agent.sector_bound))
        sector = (max(low, 0.0), max(high, 0.0))
        if not (np.isfinite(sector).all()):
            return agent
        declared: list[float] | None = None
        if unit and np.isfinite(lipschitz).all() and np.isfinite(agent.lipschitz_bound).all():
            # of the FMU as far as it was sampled, and of its model
            both = np.maximum(lipschitz, agent.lipschitz_bound)
            declared = [float(v) for v in both.max(axis=0)]
        return attrs.evolve(agent, sector=sector, lipschitz=declared)

    def residual(self, agent: Agent, signs: Array) -> tuple[float, float, int]:
        if self.f is None:
            return float("nan"), float("nan"), 0
        t, x, u = self.box.draw(self.samples, self.seed + 2)
        F = self.right_hand_side(t, x, u, signs)
        model = np.array(
            [
                agent.derivative(s, z[None, :], v[None, :])[0]
                for s, z, v in zip(t, x, u, strict=True)
            ]
        )
        size = float(np.sqrt((F**2).mean())) or 1.0
        off = F - model
        return float(np.sqrt((off**2).mean())) / size, float(np.abs(off).max()), len(t)


# ---- details ------------------------------------------------------------------------------------


def _names(letter: str, count: int) -> list[str]:
    return [f"{letter}{k + 1}" for k in range(count)]


def _digits(M: Array) -> Array:
    """Round to what is shipped: 12 significant digits of each entry."""
    return np.array([float(f"{value:.12g}") for value in M.flat]).reshape(M.shape)


def _known(M: Array) -> list[list[float]] | None:
    return M.tolist() if np.isfinite(M).all() else None


def _pair(row: Array) -> tuple[float, float]:
    return float(row[0]), float(row[1])


def _sector(effect: Array, column: Array, u: Array) -> tuple[float, float]:
    """Return the least and the largest sec(u)/u among samples."""
    ratio = effect @ column / (column @ column or 1.0) / u
    return float(ratio.min()), float(ratio.max())


def _monomials(names: Sequence[str], degree: int) -> list[str]:
    """Products of two and more names up to a degree.

    Examples
    --------
    >>> _monomials(["x1", "x2"], 2)
    ['x1*x1', 'x1*x2', 'x2*x2']
    """
    return [
        "*".join(product)
        for d in range(2, degree + 1)
        for product in combinations_with_replacement(names, d)
    ]


def _sum(terms: Sequence[tuple[float, str]]) -> str:
    """Write a sum, terms without weight left out.

    Examples
    --------
    >>> _sum([(1.0, "x1"), (-0.5, "x1*x2"), (0.0, "x2")])
    'x1 - 0.5*x1*x2'
    """
    text = ""
    for weight, name in terms:
        if weight == 0:
            continue
        size = abs(float(weight))
        factor = repr(size) if name == "1" else name if size == 1 else f"{size!r}*{name}"
        if not text:
            text = factor if weight > 0 else f"-{factor}"
        else:
            text += f" {'+' if weight > 0 else '-'} {factor}"
    return text or "0"
