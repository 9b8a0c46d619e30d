"""The agent, model (1): x' = A x + H g(t, x) + B sec(u), y = C x, with A Metzler and B ≥ 0."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import attrs
import numpy as np
import sympy

from posmas_fmi.errors import AgentError
from posmas_fmi.expression import Array, VectorFunction, symbol
from posmas_fmi.interval import Range, bounds
from posmas_fmi.sector import sector_range

if TYPE_CHECKING:
    import control

Status = Literal["verified", "declared", "contradicted"]

# Enclosures are rounded outwards, so a bound that is exact on paper comes out a few units in the
# last place too wide. Certificates use every declared bound widened by this factor instead.
ROUNDING = 1e-9


@attrs.frozen
class Assumption:
    """One assumption that a certificate rests on, and what is known about it.

    Attributes
    ----------
    name : str
        For example ``"lipschitz"``.
    status : {"verified", "declared", "contradicted"}
        Proved from the expressions; only stated by the user; refuted by a point.
    detail : str
        The numbers, for a person.
    """

    name: str
    status: Status
    detail: str


def _matrix(value: Any) -> Array:
    array = np.array(value, dtype=float)
    array.flags.writeable = False
    return array


@attrs.frozen(eq=False)
class Agent:
    """Model (1) of the paper, with what is declared about its nonlinearities.

    Parameters
    ----------
    A : (m, m) array_like
        Metzler [1/s].
    H : (m, m) array_like
        Weights of `g`.
    B : (m, p) array_like
        Non-negative.
    C : (q, m) array_like
        Output matrix.
    g : VectorFunction or callable
        Over ``t, x1, …, xm`` with m components. A callable takes t and an (N, m) array and returns
        an (N, m) array; nothing can be proved about it, and no FMU be made of it.
    sec : VectorFunction or callable
        Over ``u1, …, up``; component k depends on ``uk`` only. A callable maps (N, p) to (N, p).
    sector : (float, float)
        ``(m_l, m_h)`` of (2).
    lipschitz : float or sequence of float, optional
        Declared bound on the difference quotients of g, one for all states or one each. Without
        it the bound is computed on `region`.
    region : mapping, optional
        ``name -> (low, high)`` for ``t, x1, …``; where the bounds are examined. A missing state
        ranges over [0, inf), a missing time too, an input over all reals.
    slope : (float, float), optional
        Proved bounds of the slope of sec on the region, where who makes the agent knows some: for
        integral action. Without them the expressions are examined.

    Raises
    ------
    AgentError
        On wrong shapes, entries that are not finite, a non-Metzler A, a negative entry of B.

    Examples
    --------
    >>> agent = linear_agent(A=[[-2.0, 1.0], [1.0, -2.0]], B=[[1.0], [0.0]], C=[[1.0, 0.0]])
    >>> agent.m, agent.p, agent.q
    (2, 1, 1)
    """

    A: Array = attrs.field(converter=_matrix)
    H: Array = attrs.field(converter=_matrix)
    B: Array = attrs.field(converter=_matrix)
    C: Array = attrs.field(converter=_matrix)
    g: VectorFunction | Callable[[float, Array], Array]
    sec: VectorFunction | Callable[[Array], Array]
    sector: tuple[float, float] = (1.0, 1.0)
    lipschitz: float | Sequence[float] | None = None
    region: Mapping[str, tuple[float, float]] = attrs.field(factory=dict)
    slope: tuple[float, float] | None = None

    def __attrs_post_init__(self) -> None:
        found = [*_matrix_errors(self), *_bound_errors(self)]
        if self.A.ndim == self.B.ndim == 2:
            found += _function_errors(self)
        if found:
            found[0].problems = tuple((error.where, error.message) for error in found)
            raise found[0]

    @property
    def m(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def p(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    @property
    def q(self) -> int:
        """Number of outputs."""
        return int(self.C.shape[0])

    @cached_property
    def g_numpy(self) -> Callable[[float, Array], Array]:
        """``g(t, X)`` for X of shape (N, m), giving (N, m)."""
        if not isinstance(self.g, VectorFunction):
            return self.g
        components = self.g.numpy()
        return lambda t, X: components(t, *X.T)

    @cached_property
    def g_columns(self) -> Callable[[float, Array, Array], None]:
        """``g(t, X, out)`` for X and out of shape (m, N): a column per agent, written to out."""
        if not isinstance(self.g, VectorFunction):
            function = self.g

            def columns(t: float, X: Array, out: Array) -> None:
                out[...] = function(t, X.T).T

            return columns
        components = self.g.numpy()

        def g(t: float, X: Array, out: Array) -> None:
            components(t, *X, out=out)

        return g

    @cached_property
    def sec_numpy(self) -> Callable[[Array], Array]:
        """``sec(U)`` for U of shape (N, p), giving (N, p)."""
        if not isinstance(self.sec, VectorFunction):
            return self.sec
        components = self.sec.numpy()
        return lambda U: components(*U.T)

    def derivative(self, t: float, X: Array, U: Array) -> Array:
        """Right-hand side of (1) for N agents at once: X (N, m) and U (N, p) give (N, m)."""
        return X @ self.A.T + self.g_numpy(t, X) @ self.H.T + self.sec_numpy(U) @ self.B.T

    # -- bounds -------------------------------------------------------------------------------

    def box(self) -> dict[str, tuple[float, float]]:
        """Region in which g is examined, every variable with its interval."""
        names = ["t", *(f"x{k + 1}" for k in range(self.m))]
        return {name: self.region.get(name, (0.0, math.inf)) for name in names}

    @cached_property
    def slopes(self) -> tuple[tuple[Range, ...], ...] | None:
        """Enclosure of each ∂g_k/∂x_j on the region, (m, m); None for a callable."""
        if not isinstance(self.g, VectorFunction):
            return None
        entries = self.g.derivative([f"x{j + 1}" for j in range(self.m)]).expressions
        box = self.box()
        declared = np.inf if self.lipschitz is None else np.asarray(self.lipschitz, dtype=float)
        claims = np.broadcast_to(declared * (1 + ROUNDING), (self.m, self.m)).ravel()
        ranges = [bounds(e, box, (-c, c)) for e, c in zip(entries, claims, strict=True)]
        return tuple(tuple(ranges[k * self.m : (k + 1) * self.m]) for k in range(self.m))

    @cached_property
    def lipschitz_bound(self) -> Array:
        """Bound on ``|∂g_k/∂x_j|`` over the region from the expressions, (m, m); inf if unknown."""
        if self.slopes is None:
            return np.full((self.m, self.m), np.inf)
        return np.array([[entry.magnitude for entry in row] for row in self.slopes])

    @cached_property
    def ell(self) -> Array:
        """ℓ as a matrix (m, m): the bound on each difference quotient that certificates use.

        The declared bound where there is one (on the entries that g has), else the computed one.
        """
        if self.lipschitz is None:
            return self.lipschitz_bound
        declared = np.broadcast_to(np.asarray(self.lipschitz, dtype=float), (self.m,))
        present = self.lipschitz_bound > 0  # a g_k that does not contain x_j has no slope there
        return np.where(present, declared[None, :] * (1 + ROUNDING), 0.0)

    @property
    def H_ell(self) -> Array:
        """``|H| ℓ``, (m, m): entrywise bound on H times a difference quotient of g."""
        with np.errstate(invalid="ignore"):
            product = np.abs(self.H)[:, :, None] * self.ell[None, :, :]
        return np.asarray(np.nan_to_num(product, nan=0.0, posinf=np.inf).sum(axis=1))

    @cached_property
    def growth(self) -> Array:
        """Growth bound c, ``|g_k(t, x)| ≤ c_k x_k`` on the region, (m,); inf if there is none.

        Positivity needs ``H g ≥ -|H| c x``; c_k is 0 where g_k and its column of H are
        non-negative, however large they are (a heat load).
        """
        if not isinstance(self.g, VectorFunction):
            return np.full(self.m, np.inf)
        ratios = (sympy.expand(e / symbol(f"x{k + 1}")) for k, e in enumerate(self.g.expressions))
        return np.array(
            [0.0 if self._only_adds(k) else self._ratio_bound(e, k) for k, e in enumerate(ratios)]
        )

    def _only_adds(self, k: int) -> bool:
        assert isinstance(self.g, VectorFunction)
        rising = bool((self.H[:, k] >= 0).all())
        return rising and bounds(self.g.expressions[k], self.box(), (0.0, math.inf)).low >= 0

    def _ratio_bound(self, ratio: sympy.Expr, k: int) -> float:
        direct = bounds(ratio, self.box()).magnitude
        if math.isfinite(direct) or self.slopes is None or not isinstance(self.g, VectorFunction):
            return direct
        # g_k(t, 0) = 0 in x_k alone: the mean value theorem bounds g_k / x_k by the slope
        others = [self.slopes[k][j].magnitude for j in range(self.m) if j != k]
        at_zero = self.g.expressions[k].subs(symbol(f"x{k + 1}"), 0)
        return self.slopes[k][k].magnitude if at_zero == 0 and not any(others) else math.inf

    @cached_property
    def sector_bound(self) -> tuple[Range, ...] | None:
        """Enclosure of ``sec_k(u)/u`` for each input; None for a callable."""
        if not isinstance(self.sec, VectorFunction):
            return None
        return tuple(
            sector_range(
                e,
                f"u{k + 1}",
                self.region.get(f"u{k + 1}", (-math.inf, math.inf)),
                (self.m_l, self.m_h),
            )
            for k, e in enumerate(self.sec.expressions)
        )

    @property
    def m_l(self) -> float:
        """Lower sector bound that certificates use."""
        return self.sector[0] * (1 - ROUNDING)

    @property
    def m_h(self) -> float:
        """Upper sector bound that certificates use."""
        return self.sector[1] * (1 + ROUNDING)

    def assumptions(self) -> tuple[Assumption, ...]:
        """Say what is known about the sector, the Lipschitz bound and the growth of g."""
        return (self._sector_assumption(), self._lipschitz_assumption(), self._growth_assumption())

    def _sector_assumption(self) -> Assumption:
        low, high = self.sector
        name = "sector"
        if self.sector_bound is None:
            return Assumption(name, "declared", f"[{low:g}, {high:g}], sec is not an expression")
        for k, r in enumerate(self.sector_bound):
            for value, at in ((r.least, r.argmin), (r.most, r.argmax)):
                if not self.m_l <= value <= self.m_h:
                    return Assumption(
                        name,
                        "contradicted",
                        f"[{low:g}, {high:g}] declared, sec(u{k + 1})/u{k + 1} = {value:.6g} "
                        f"at {_point(at)}",
                    )
        inside = all(self.m_l <= r.low and r.high <= self.m_h for r in self.sector_bound)
        hull = min(r.low for r in self.sector_bound), max(r.high for r in self.sector_bound)
        detail = f"[{low:g}, {high:g}] declared, computed [{hull[0]:.6g}, {hull[1]:.6g}]"
        return Assumption(name, "verified" if inside else "declared", detail)

    def _lipschitz_assumption(self) -> Assumption:
        name = "lipschitz"
        region = ", ".join(f"{n} in [{a:g}, {b:g}]" for n, (a, b) in self.box().items())
        if self.slopes is None:
            return Assumption(name, "declared", f"{self.lipschitz!r}, g is not an expression")
        if self.lipschitz is None:
            top = float(self.lipschitz_bound.max())
            return Assumption(name, "verified", f"computed: slopes of g <= {top:.6g} for {region}")
        for k, row in enumerate(self.slopes):
            for j, r in enumerate(row):
                for value, at in ((r.least, r.argmin), (r.most, r.argmax)):
                    if abs(value) > self.ell[k, j]:
                        return Assumption(
                            name,
                            "contradicted",
                            f"{self.lipschitz!r} declared, dg{k + 1}/dx{j + 1} = {value:.4g} "
                            f"at {_point(at)}; |slopes| reach {self.lipschitz_bound.max():.4g} "
                            f"for {region}",
                        )
        proved = bool((self.lipschitz_bound <= self.ell).all())
        worst = float(self.lipschitz_bound.max())
        detail = f"{self.lipschitz!r} declared, |slopes| <= {worst:.6g} for {region}"
        return Assumption(name, "verified" if proved else "declared", detail)

    def _growth_assumption(self) -> Assumption:
        name = "growth"
        c = self.growth
        if not np.isfinite(c).all():
            detail = "no bound |g_k| <= c_k x_k found on the region"
            return Assumption(name, "declared", detail)
        detail = f"|g_k(t, x)| <= c_k x_k with c = {_numbers(c)}"
        if isinstance(self.g, VectorFunction):
            adds = [k for k, e in enumerate(self.g.expressions) if e != 0 and self._only_adds(k)]
            detail += "; 0 where H g only adds to the states" if adds else ""
        return Assumption(name, "verified", detail)

    # -- python-control -----------------------------------------------------------------------

    def to_statespace(self) -> control.StateSpace:
        """Return the linear part ``(A, B, C, 0)`` as a `control.StateSpace`."""
        import control

        inputs, outputs = _labels("u", self.p), _labels("y", self.q)
        zero = np.zeros((self.q, self.p))
        return control.StateSpace(
            self.A,
            self.B,
            self.C,
            zero,
            inputs=inputs,
            outputs=outputs,
            states=_labels("x", self.m),
        )

    def to_iosystem(self) -> control.NonlinearIOSystem:
        """Return model (1) as a `control.NonlinearIOSystem`.

        Examples
        --------
        >>> import control
        >>> agent = linear_agent([[-1.0]], [[2.0]], [[1.0]])
        >>> control.linearize(agent.to_iosystem(), [0.0], [0.0]).A
        array([[-1.]])
        """
        import control

        def update(t: float, x: Array, u: Array, params: object) -> Array:
            rows = self.derivative(t, np.reshape(x, (1, -1)), np.reshape(u, (1, -1)))
            return np.asarray(rows[0])

        def output(t: float, x: Array, u: Array, params: object) -> Array:
            return np.asarray(self.C @ x)

        return control.NonlinearIOSystem(
            update,
            output,
            inputs=_labels("u", self.p),
            outputs=_labels("y", self.q),
            states=_labels("x", self.m),
        )

    @cached_property
    def controllable(self) -> bool:
        """Whether (A, B) is controllable."""
        return self._full_rank("ctrb", self.A, self.B)

    @cached_property
    def observable(self) -> bool:
        """Whether (A, C) is observable."""
        return self._full_rank("obsv", self.A, self.C)

    def _full_rank(self, name: str, first: Array, second: Array) -> bool:
        import control

        return bool(np.linalg.matrix_rank(getattr(control, name)(first, second)) == self.m)

    @cached_property
    def hurwitz(self) -> bool:
        """Whether every pole of the linear part lies in the open left half-plane."""
        return bool((self.to_statespace().poles().real < 0).all())


def linear_agent(A: Any, B: Any, C: Any, sector: tuple[float, float] = (1.0, 1.0)) -> Agent:
    """Agent without g and with ``sec(u) = u``.

    Parameters
    ----------
    A : (m, m) array_like
    B : (m, p) array_like
    C : (q, m) array_like
    sector : (float, float)
        Sector to design for; holds 1.

    Returns
    -------
    Agent
    """
    A, B = np.asarray(A, dtype=float), np.asarray(B, dtype=float)
    names = [f"u{k + 1}" for k in range(B.shape[1])]
    return Agent(
        A=A,
        H=np.zeros_like(A),
        B=B,
        C=C,
        g=VectorFunction.parse(["0"] * len(A), state_names(len(A))),
        sec=VectorFunction.parse(names, names),
        sector=sector,
    )


def state_names(m: int) -> list[str]:
    """Variables of g: ``t, x1, …, xm``."""
    return ["t", *_labels("x", m)]


def is_metzler(M: Any, tolerance: float = 0.0) -> bool:
    """Whether every off-diagonal entry is at least ``-tolerance``."""
    M = np.asarray(M)
    off = M[~np.eye(len(M), dtype=bool)]
    return bool((off >= -tolerance).all())


def _labels(prefix: str, count: int) -> list[str]:
    return [f"{prefix}{k + 1}" for k in range(count)]


def _numbers(values: Array) -> str:
    return "[" + ", ".join(f"{v:.6g}" for v in values) + "]"


def _point(at: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {value:.4g}" for name, value in sorted(at.items())) or "any point"


def _matrix_errors(agent: Agent) -> Iterator[AgentError]:
    m = agent.A.shape[0] if agent.A.ndim == 2 else 0
    p = agent.B.shape[1] if agent.B.ndim == 2 else 0
    q = agent.C.shape[0] if agent.C.ndim == 2 else 0
    expected = {
        "A": ((m, m), "(m, m)"),
        "H": ((m, m), "(m, m), as A"),
        "B": ((m, p), "(m, p), one row per state"),
        "C": ((q, m), "(q, m), one column per state"),
    }
    for name, (shape, words) in expected.items():
        value: Array = getattr(agent, name)
        place = f"$.agent.{name}"
        if value.shape != shape or value.size == 0:
            wanted = f"{words} with m = {m}" if m else words
            yield AgentError(f"expected a matrix of shape {wanted} (got {value.shape})", place)
        elif not np.isfinite(value).all():
            i, j = np.argwhere(~np.isfinite(value))[0]
            yield AgentError(f"expected finite numbers (got {value[i, j]})", f"{place}[{i}][{j}]")
    off = agent.A - np.diag(np.diag(agent.A)) if m and m == agent.A.shape[1] else np.eye(1)
    if (off < 0).any():
        i, j = np.argwhere(off < 0)[0]
        yield AgentError(
            "A must be Metzler, that is have no negative entry off its diagonal "
            f"(got {agent.A[i, j]:g}); a positive system needs it, check the sign or the states",
            f"$.agent.A[{i}][{j}]",
        )
    if agent.B.ndim == 2 and (agent.B < 0).any():
        i, j = np.argwhere(agent.B < 0)[0]
        yield AgentError(
            f"B must be non-negative (got {agent.B[i, j]:g}); redefine the input with the "
            "opposite sign if all of its column is negative",
            f"$.agent.B[{i}][{j}]",
        )


def _function_errors(agent: Agent) -> Iterator[AgentError]:
    for name, count, shape in (("g", agent.m, "state"), ("sec", agent.p, "input")):
        value = getattr(agent, name)
        if isinstance(value, VectorFunction):
            if len(value) != count:
                yield AgentError(
                    f"expected {count} expression(s), one per {shape} (got {len(value)})",
                    f"$.agent.{name}",
                )
        elif not callable(value):
            yield AgentError(
                f"expected expressions or a callable (got {value!r})", f"$.agent.{name}"
            )
    if isinstance(agent.sec, VectorFunction):
        for k, e in enumerate(agent.sec.expressions):
            others = {str(s) for s in e.free_symbols} - {f"u{k + 1}"}
            if others:
                yield AgentError(
                    f"sec is elementwise: expected a function of u{k + 1} only "
                    f"(got {', '.join(sorted(others))} as well)",
                    f"$.agent.sec[{k}]",
                )


def _bound_errors(agent: Agent) -> Iterator[AgentError]:
    low, high = agent.sector
    if not 0.0 <= low <= high < math.inf:
        yield AgentError(
            f"expected 0 <= m_l <= m_h < inf (got [{low:g}, {high:g}])", "$.agent.sector"
        )
    if agent.lipschitz is None:
        return
    declared = np.atleast_1d(np.asarray(agent.lipschitz, dtype=float))
    sizes = {1, *agent.A.shape[:1]}
    if declared.size not in sizes or not (np.isfinite(declared).all() and (declared >= 0).all()):
        yield AgentError(
            f"expected one finite bound >= 0, or one per state (got {agent.lipschitz!r})",
            "$.agent.lipschitz",
        )
