"""Linear models of FMUs: x' = A x + B u, y = C x + D u around an operating point."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from posmas_fmi.errors import FmuError, InputError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.differences import jacobian, steps_for
from posmas_fmi.fmu.evaluation import (
    Equations,
    Interface,
    Point,
    Signals,
    Values,
    bring_to,
    check_values,
    default_step,
    differentiates,
    equations,
    labels,
    open_fmu,
    signals,
    steps_vary,
)
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.model_exchange import ModelExchangeInstance
from posmas_fmi.fmu.step_response import Sampled, continuous, from_pulses, from_restarts

if TYPE_CHECKING:
    import control

_LOG = logging.getLogger(__name__)
_AGREE = 1e-4  # relative: directional derivatives and differences say the same
_MISFIT = 1e-3  # relative: a response that a linear model misses
_NO_USE = 0.1  # relative error of the largest entry from which on a model is of no use

DIRECTIONAL = "directional derivatives"
DIFFERENCES = "central differences"


@attrs.frozen(eq=False)
class Linearisation:
    """A linear model of an FMU in deviations from an operating point.

    Attributes
    ----------
    A, B, C, D : ndarray
        (m, m), (m, p), (q, m), (q, p); of x' = A x + B u, or of x₊ = A x + B u if `dt` > 0.
    states, inputs, outputs : tuple of str
        FMU variables; states are ``z1, z2, …`` where the FMU shows none.
    named : bool
        Whether the states are variables of the FMU.
    dt : float
        0 for a continuous model; else the communication step [s] of one that has no continuous
        equivalent.
    at : float
        Time of the operating point [s].
    x0, u0, y0 : ndarray
        Operating point; x0 is zero where the states are not named.
    rate0 : ndarray or None
        Derivatives there, (m,); None where the FMU does not tell them. Zero at an equilibrium.
    interface : str
        ``"Model Exchange"`` or ``"Co-Simulation"``.
    method : str
        ``"directional derivatives"``, ``"central differences, state restored"`` or
        ``"central differences, fresh instances"``.
    step : float or None
        Communication step of the samples that A and B were computed from [s]; None if the
        derivatives were there to be read.
    steps : ndarray
        Perturbations of states and inputs (of the inputs alone, if pulses were used); empty for
        directional derivatives.
    error : float or None
        Largest estimated error of an entry of A and B (an upper bound rather than the last digit);
        for directional derivatives the largest disagreement with differences along one direction,
        None if there was nothing to compare with.
    noise : float
        Largest change of a value when it was computed again at the same place.
    notes : tuple of str
        What was tried and did not work, and what to know about the result.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    named: bool
    dt: float
    at: float
    x0: Array
    u0: Array
    y0: Array
    rate0: Array | None
    interface: str
    method: str
    step: float | None
    steps: Array
    error: float | None
    noise: float
    notes: tuple[str, ...] = ()

    def to_statespace(self) -> control.StateSpace:
        """Return the model as a `control.StateSpace`."""
        import control

        return control.StateSpace(
            *(self.A, self.B, self.C, self.D, self.dt),
            inputs=labels(self.inputs),
            outputs=labels(self.outputs),
            states=labels(self.states),
            remove_useless_states=False,
        )

    @property
    def poles(self) -> Array:
        """Eigenvalues of A, the least stable first, (m,) complex."""
        values = np.linalg.eigvals(self.A).astype(complex)
        key = np.abs(values) if self.dt else values.real
        return np.asarray(values[np.argsort(-key, kind="stable")])

    @property
    def stable(self) -> bool:
        """Whether A is Hurwitz (inside the unit circle, for a sampled model)."""
        return bool((np.abs(self.poles) < 1).all() if self.dt else (self.poles.real < 0).all())

    @property
    def uncertainty(self) -> float | None:
        """`error` relative to the largest entry of A and B; None where the error is unknown."""
        if self.error is None:
            return None
        entries = [self.A, self.B] if self.A.size + self.B.size else [self.D]
        size = max(float(np.abs(M).max(initial=0.0)) for M in entries)
        if size == 0.0:
            return 0.0 if self.error == 0.0 else np.inf
        return self.error / size

    @property
    def useful(self) -> bool:
        """Whether the estimated error leaves the largest entry of A and B a digit: below 10 %.

        Small entries can be unknown all the same: compare each with `error`.
        """
        return self.uncertainty is None or self.uncertainty < _NO_USE

    @property
    def metzler(self) -> MetzlerReport:
        """What keeps the model from being positive."""
        return metzler_report(self.A, self.B, self.error or 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as lists and numbers, for JSON."""
        content: dict[str, Any] = attrs.asdict(self)
        for key, value in content.items():
            if isinstance(value, np.ndarray):
                content[key] = value.tolist()
        content["poles"] = [[float(z.real), float(z.imag)] for z in self.poles]
        content["stable"] = self.stable
        content["useful"] = self.useful
        # entries mean something only between states that are quantities
        content["metzler"] = self.metzler.to_dict() if self.named and not self.dt else None
        return content


@attrs.frozen(eq=False)
class MetzlerReport:
    """How far (A, B) are from a positive system.

    Attributes
    ----------
    metzler : bool
        Whether no off-diagonal entry of A is below minus the tolerance.
    negative : tuple of (int, int, float)
        Row, column (from 1) and value of the entries that are, lowest first.
    nearest : (m, m) ndarray
        The nearest Metzler matrix, in every entrywise norm: those entries set to 0.
    distance : float
        Frobenius norm of the difference.
    negative_B : tuple of (int, int, float)
        The same for entries of B below minus the tolerance.
    tolerance : float
        What is within the error of the entries.
    """

    metzler: bool
    negative: tuple[tuple[int, int, float], ...]
    nearest: Array
    distance: float
    negative_B: tuple[tuple[int, int, float], ...]
    tolerance: float

    def to_dict(self) -> dict[str, Any]:
        """Return everything as lists and numbers, for JSON."""
        return {**attrs.asdict(self), "nearest": self.nearest.tolist()}


def metzler_report(A: Array, B: Array, tolerance: float = 0.0) -> MetzlerReport:
    """Report which entries keep x' = A x + B u from being a positive system.

    Parameters
    ----------
    A : (m, m) ndarray
    B : (m, p) ndarray
    tolerance : float
        Entries from minus this on count as zero.

    Examples
    --------
    >>> report = metzler_report(np.array([[-1.0, -0.5], [2.0, -1.0]]), np.eye(2))
    >>> report.metzler, report.negative, report.distance
    (False, ((1, 2, -0.5),), 0.5)
    """
    off = ~np.eye(len(A), dtype=bool)
    nearest = np.where(off, np.maximum(A, 0.0), A)
    negative = _entries(A, off & (-tolerance > A))
    return MetzlerReport(
        metzler=not negative,
        negative=negative,
        nearest=nearest,
        distance=float(np.linalg.norm(A - nearest)),
        negative_B=_entries(B, -tolerance > B),
        tolerance=tolerance,
    )


def _entries(M: Array, where: Any) -> tuple[tuple[int, int, float], ...]:
    found = [
        (int(i) + 1, int(j) + 1, float(M[i, j])) for i, j in zip(*np.where(where), strict=True)
    ]
    return tuple(sorted(found, key=lambda entry: entry[2]))


def linearise(
    path: str | Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    at: float = 0.0,
    *,
    values: Values | None = None,
    states: Sequence[str] | None = None,
    interface: Interface | None = None,
    step: float | None = None,
) -> Linearisation:
    """Linearise an FMU along its trajectory, at one time.

    The first way that works is taken:

    1. directional derivatives, compared with differences along one direction;
    2. central differences of the derivatives and outputs: in Model Exchange, or in the
       Initialization Mode of a Co-Simulation FMU that shows its derivatives;
    3. central differences over one communication step from states that can be set;
    4. pulses on the inputs, and a realisation of the responses.

    3 and 4 give a sampled model; A and B are those of the continuous system that it samples.

    Parameters
    ----------
    path : path-like
    inputs, outputs : sequence of str
        Variables or elements (``u[1]``); an array's name stands for all of its elements.
    at : float
        Time [s]; the inputs are held on the way there.
    values : mapping, optional
        Parameters, start values and inputs by name; those of the file by default.
    states : sequence of str, optional
        Variables that are the states, if the FMU does not declare any.
    interface : {"Model Exchange", "Co-Simulation"}, optional
        Model Exchange by default, if the FMU has it.
    step : float, optional
        Communication step for 3 and 4 and on the way to `at` [s]; the FMU's own by default.

    Returns
    -------
    Linearisation

    Raises
    ------
    InputError
        If there is no such file or variable.
    FmuError
        If the FMU fails, or none of the ways works.

    Examples
    --------
    >>> from posmas_fmi.expression import VectorFunction
    >>> from posmas_fmi.fmu.build import agent_fmu
    >>> g = VectorFunction.parse(["0"], ["t", "x1"])
    >>> path = agent_fmu(g, VectorFunction.parse(["tanh(u1)"], ["u1"]), 1, 1, 1)
    >>> made = linearise(path, ["u"], ["y"], values={"A": [[-2.0]], "B": [[3.0]]})
    >>> made.method, made.A, made.B
    ('directional derivatives', array([[-2.]]), array([[3.]]))
    """
    values = dict(values or {})
    _check(at, step)
    with open_fmu(path, interface) as file:
        names = signals(file, inputs, outputs, states)
        check_values(file, values)
        return linearise_open(file, names, at, values, step)


def linearise_open(
    file: FmuFile, names: Signals, at: float, values: Values, step: float | None
) -> Linearisation:
    """Linearise an FMU that is loaded; see `linearise`."""
    held = step or default_step(file)
    with file.instantiate("linearise") as instance:
        bring_to(instance, at, values, held)
        point = operating_point(instance, names, at)
        return _Ladder(file, names, values, instance, point, held).climb()


def _check(at: float, step: float | None) -> None:
    if not np.isfinite(at):
        raise InputError(f"expected a finite time (got {at})")
    if step is not None and not (0 < step < np.inf):
        raise InputError(f"expected a communication step > 0 s (got {step})")


def operating_point(instance: FmuInstance, names: Signals, at: float) -> Point:
    """Read the operating point that an instance is at."""
    file = instance.file

    def read(some: Sequence[str]) -> Array:
        return instance.read(file.ports(some)) if some else np.zeros(0)

    x = instance.states() if isinstance(instance, ModelExchangeInstance) else read(names.states)
    return Point(at, x, read(names.inputs), read(names.outputs))


@attrs.frozen(eq=False)
class _Ladder:
    """The ways to linearise, one after the other."""

    file: FmuFile
    names: Signals
    values: Values
    instance: FmuInstance
    point: Point
    step: float
    notes: list[str] = attrs.field(factory=list)

    def climb(self) -> Linearisation:
        f = self.equations()
        if self.names.derivatives and differentiates(self.file):
            made = self.attempt(DIRECTIONAL, lambda: self.directional(f))
            if made is not None:
                return made
        if f is not None:
            made = self.attempt(DIFFERENCES, lambda: self.by_differences(f))
            if made is not None:
                return made
        return self.by_steps()

    def attempt(self, what: str, way: Callable[[], Linearisation]) -> Linearisation | None:
        try:
            return way()
        except FmuError as error:
            _LOG.info("%s: %s", what, error)
            self.notes.append(f"{what}: {error.message}")
            return None

    def equations(self) -> Equations | None:
        """Return the first way to evaluate the equations that works at the operating point."""
        for way in equations(self.file, self.names, self.values, self.instance):
            try:
                f = way()
                m, z = len(self.point.x), np.concatenate([self.point.x, self.point.u])
                # setting what is there already proves little; it comes last, so that a Model
                # Exchange instance is left at the operating point
                for at in (z + self.steps(), z):
                    f(self.point.time, at[:m], at[m:])
            except FmuError as error:
                note = f"derivatives read in Initialization Mode: {error.message}"
                if note not in self.notes:
                    self.notes.append(note)
                continue
            return f
        return None

    # ---- directional derivatives ------------------------------------------------------------

    def directional(self, f: Equations | None) -> Linearisation:
        names, point = self.names, self.point
        m = len(names.states)
        knowns = (*names.states, *names.inputs)
        direct = self.unit_rows()  # outputs that are states
        others = [k for k, row in enumerate(direct) if row is None]
        unknowns = (*names.derivatives, *(names.outputs[k] for k in others))
        columns = self.columns(unknowns, knowns)
        J = np.zeros((m + len(names.outputs), len(knowns)))
        J[:m] = columns[:m]
        J[[m + k for k in others]] = columns[m:]
        for k, row in enumerate(direct):
            if row is not None:
                J[m + k, row] = 1.0
        error = None
        if f is not None:
            error = self.disagreement(f, J)
            if error > _AGREE * max(1.0, float(np.abs(J).max(initial=0.0))):
                raise FmuError(f"they are off by {error:.3g} from differences along one direction")
        else:
            self.notes.append("there was nothing to compare the directional derivatives with")
        rate = None if f is None else f(point.time, point.x, point.u)[0]
        return self.result(J, rate, DIRECTIONAL, np.zeros(0), error, 0.0)

    def unit_rows(self) -> list[int | None]:
        """Return for each output which state it is, if it is one (also by another name)."""

        def place(name: str) -> tuple[int, int]:
            port = self.file.ports([name])
            return port.references[0], int(port.places[0])

        states = {place(name): k for k, name in enumerate(self.names.states)}
        return [states.get(place(name)) for name in self.names.outputs]

    def columns(self, unknowns: Sequence[str], knowns: Sequence[str]) -> Array:
        J = np.empty((len(unknowns), len(knowns)))
        for j, known in enumerate(knowns):
            J[:, j] = self.instance.directional_derivative(unknowns, [known], [1.0])
        if not np.isfinite(J).all():
            raise FmuError("they are not finite", self.file.path.name)
        return J

    def disagreement(self, f: Equations, J: Array) -> float:
        """Compare with the difference along one direction, all states and inputs at once."""
        m = len(self.point.x)
        z = np.concatenate([self.point.x, self.point.u])
        # any fixed direction without structure: signs and sizes differ
        direction = np.cos(np.arange(1, z.size + 1) * 1.7) * self.steps()
        made = jacobian(
            lambda a: np.concatenate(
                f(self.point.time, (z + a * direction)[:m], (z + a * direction)[m:])
            ),
            np.zeros(1),
            np.ones(1),
        )
        size = float(np.abs(direction).max(initial=0.0)) or 1.0
        return float(np.abs(made.value[:, 0] - J @ direction).max(initial=0.0)) / size

    # ---- central differences ----------------------------------------------------------------

    def steps(self) -> Array:
        names = (*self.names.states, *self.names.inputs)
        nominal = np.array([self.file.variable(name).nominal for name in names])
        return steps_for(np.concatenate([self.point.x, self.point.u]), nominal)

    def by_differences(self, f: Equations) -> Linearisation:
        point, m = self.point, len(self.point.x)
        made = jacobian(
            lambda z: np.concatenate(f(point.time, z[:m], z[m:])),
            np.concatenate([point.x, point.u]),
            self.steps(),
        )
        rate = f(point.time, point.x, point.u)[0]
        error = float(made.error.max(initial=0.0))
        return self.result(
            made.value, rate, f"{DIFFERENCES}, {f.how}", made.steps, error, made.noise
        )

    def result(
        self,
        J: Array,
        rate: Array | None,
        method: str,
        steps: Array,
        error: float | None,
        noise: float,
    ) -> Linearisation:
        m = len(self.names.states)
        return Linearisation(
            *(J[:m, :m], J[:m, m:], J[m:, :m], J[m:, m:]),
            states=self.names.states,
            named=True,
            dt=0.0,
            x0=self.point.x,
            rate0=rate,
            method=method,
            step=None,
            steps=steps,
            error=error,
            noise=noise,
            **self.common(),
        )

    def common(self) -> dict[str, Any]:
        return {
            "inputs": self.names.inputs,
            "outputs": self.names.outputs,
            "at": self.point.time,
            "u0": self.point.u,
            "y0": self.point.y,
            "interface": self.file.kind,
            "notes": tuple(self.notes),
        }

    # ---- communication steps ----------------------------------------------------------------

    def by_steps(self) -> Linearisation:
        if self.names.states:
            made = self.attempt("states set at the start", self.by_restarts)
            if made is not None:
                return made
        return self.sampled(
            from_pulses(self.file, self.names, self.values, self.instance, self.point, self.step)
        )

    def by_restarts(self) -> Linearisation:
        """Step from states that are set; with half the step as well, if the FMU takes that.

        Away from an equilibrium, or through a solver of low order, A and B of a step are off in
        proportion to the step: that part is extrapolated away.
        """
        whole = self.sampled(self.restarts(self.step))
        if whole.dt or not steps_vary(self.file):
            return whole
        half = self.sampled(self.restarts(self.step / 2))
        if half.dt:
            return whole
        assert half.error is not None
        A, B = 2 * half.A - whole.A, 2 * half.B - whole.B
        moved = max(float(np.abs(M - N).max(initial=0.0)) for M, N in ((A, half.A), (B, half.B)))
        return attrs.evolve(whole, A=A, B=B, error=max(moved, 3 * half.error))

    def restarts(self, step: float) -> Sampled:
        return from_restarts(self.file, self.names, self.values, self.point, step)

    def sampled(self, made: Sampled) -> Linearisation:
        found = continuous(made)
        A, B = (made.Ad, made.Bd) if found is None else found
        notes = list(self.notes)
        if found is None:
            notes.append("no continuous system has these samples: this is the sampled model itself")
        order = len(A)
        if made.misfit > _MISFIT:
            notes.append(
                f"the responses are not those of a linear system of order {order}: off by "
                f"{made.misfit:.2g} of the largest, or as much between large and small pulses"
            )
        if not made.named:
            notes.append(
                "the FMU shows no states: these are coordinates of what the inputs reach and the "
                "outputs show"
            )
        return Linearisation(
            *(A, B, made.C, made.D),
            states=self.names.states if made.named else tuple(f"z{k + 1}" for k in range(order)),
            named=made.named,
            dt=made.step if found is None else 0.0,
            x0=self.point.x if made.named else np.zeros(order),
            rate0=None,
            method=f"{DIFFERENCES}, {made.how}",
            step=made.step,
            steps=made.steps,
            error=made.error if found is None else made.error / made.step,
            noise=made.noise,
            **{**self.common(), "notes": tuple(notes)},
        )
