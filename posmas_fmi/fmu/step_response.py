"""Linear models of a Co-Simulation FMU from what its communication steps do."""

from __future__ import annotations

import attrs
import numpy as np

from posmas_fmi.errors import FmuCallError, FmuError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.differences import jacobian, steps_for
from posmas_fmi.fmu.evaluation import (
    Point,
    Restart,
    Signals,
    Values,
    bring_to,
    saves_state,
)
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance

_SAMPLES = 41  # of a pulse response
_FEWEST = 9
_GROWTH = 1e3
_LARGEST_ORDER = 20
_NOTHING = 1e-150
_FIT = 1e-7  # relative: a response is explained
_RANK = 1e-7  # relative: smaller singular values of the Hankel matrix are noise
_REAL = 1e-6  # relative: what is left by rounding, of a logarithm or a direct term


@attrs.frozen(eq=False)
class Sampled:
    """A sampled linear model, x₊ = Ad x + Bd u, y = C x + D u.

    Attributes
    ----------
    Ad, Bd, C, D : ndarray
    step : float
        Communication step [s].
    error : float
        Largest estimated error of an entry, or of a pulse response and of the fit to it.
    noise : float
        Largest change of an output when the same step is done again.
    how : str
        ``"state restored"`` or ``"fresh instances"``.
    steps : (p,) or (m + p,) ndarray
        Perturbations.
    named : bool
        Whether x are the states of `Signals`.
    misfit : float
        Of the responses that it was realised from, or between those to large and to small
        pulses, relative to the largest sample.
    """

    Ad: Array
    Bd: Array
    C: Array
    D: Array
    step: float
    error: float
    noise: float
    how: str
    steps: Array
    named: bool
    misfit: float = 0.0


def continuous(sampled: Sampled) -> tuple[Array, Array] | None:
    """Return A and B of the system that is sampled; None if there is no real one.

    Ad = e^{Ah} and Bd = ∫₀ʰ e^{Aτ}dτ B stand in e^{Mh} with M = [[A, B], [0, 0]]; so M is the
    principal logarithm over h. That is exact while the imaginary parts of A's eigenvalues are
    below π/h.

    Examples
    --------
    >>> Ad, Bd = np.array([[np.exp(-1.0)]]), np.array([[1 - np.exp(-1.0)]])
    >>> one = np.ones((1, 1))
    >>> s = Sampled(Ad, Bd, one, 0 * one, 0.5, 0.0, 0.0, "state restored", one[0], True)
    >>> [float(M[0, 0].round(12)) for M in continuous(s)]
    [-2.0, 2.0]
    """
    from scipy.linalg import logm

    m, p = sampled.Bd.shape
    if m == 0:
        return sampled.Ad, sampled.Bd
    eigenvalues = np.linalg.eigvals(sampled.Ad)
    small = np.abs(eigenvalues) < 1e-9 * max(1.0, float(np.abs(eigenvalues).max()))
    if small.any() or ((eigenvalues.real < 0) & (np.abs(eigenvalues.imag) < 1e-9)).any():
        return None
    block = np.eye(m + p)
    block[:m, :m], block[:m, m:] = sampled.Ad, sampled.Bd
    block[np.abs(block) < _NOTHING] = 0.0  # the logarithm divides by what is there
    M = np.asarray(logm(block)) / sampled.step
    if np.abs(M.imag).max() > _REAL * max(1.0, float(np.abs(M).max())):
        return None
    return np.asarray(M.real[:m, :m]), np.asarray(M.real[:m, m:])


def from_restarts(
    file: FmuFile, names: Signals, values: Values, point: Point, step: float
) -> Sampled:
    """Perturb states and inputs of fresh instances, and let each make one step.

    Parameters
    ----------
    file : FmuFile
    names : Signals
        With states.
    values : mapping
    point : Point
    step : float
        Communication step [s].

    Raises
    ------
    FmuError
        If the states do not start where they are told.
    """
    restart = Restart(file, names, values)
    m, q = len(names.states), len(names.outputs)
    after = file.ports([*names.states, *names.outputs])
    now = file.ports(names.outputs)

    def stepped(z: Array) -> Array:
        """Return the state after the step, and the outputs before it."""
        with restart.prepared(point.time, z[:m], z[m:]) as instance:
            y = instance.read(now)
            instance.exit_initialization()
            instance.do_step(point.time, step)
            return np.concatenate([instance.read(after)[:m], y])

    nominal = np.array([file.variable(n).nominal for n in (*names.states, *names.inputs)])
    z = np.concatenate([point.x, point.u])
    made = jacobian(stepped, z, steps_for(z, nominal))
    Ad, Bd = made.value[:m, :m], made.value[:m, m:]
    C, D = made.value[m : m + q, :m], made.value[m : m + q, m:]
    error = float(made.error.max(initial=0.0))
    return Sampled(Ad, Bd, C, D, step, error, made.noise, "fresh instances", made.steps, True)


def from_pulses(
    file: FmuFile,
    names: Signals,
    values: Values,
    instance: FmuInstance,
    point: Point,
    step: float,
) -> Sampled:
    """Give each input a pulse of one step, and realise the responses (Ho and Kalman; ERA).

    Finds what the inputs reach and the outputs show, in any coordinates; where the states of
    `names` can be read, in theirs.

    Parameters
    ----------
    file : FmuFile
    names : Signals
    values : mapping
    instance : FmuInstance
        At the operating point.
    point : Point
    step : float
        Communication step [s].

    Raises
    ------
    FmuError
        If the FMU has no inputs to give a pulse to, or the states are not all reached.
    """
    if not names.inputs or not (names.states or names.outputs):
        raise FmuError(
            "expected states that can be set, or inputs and outputs (the FMU shows neither)",
            file.path.name,
        )
    runs = _Runs(file, names, values, instance, point, step)
    pulses = steps_for(point.u, np.array([file.variable(n).nominal for n in names.inputs]))
    made = jacobian(lambda u: runs(u).ravel(), point.u, pulses)
    shape = (_SAMPLES, -1, len(names.inputs))
    markov = made.value.reshape(shape).transpose(1, 2, 0)
    kept = _bounded(markov)
    uncertain = made.error.reshape(shape).transpose(1, 2, 0)[:, :, :kept]
    Ad, Bd, C, D, error, misfit = _realise(markov[:, :, :kept], uncertain, names, file.path.name)
    named = bool(names.states)
    return Sampled(Ad, Bd, C, D, step, error, made.noise, runs.how, pulses, named, misfit)


def _bounded(markov: Array) -> int:
    """Count the samples before an unstable response hides its own beginning."""
    sizes = np.abs(markov).max(axis=(0, 1), initial=0.0)
    beyond = np.flatnonzero(sizes > _GROWTH * max(sizes[:2].max(), np.finfo(float).tiny))
    first = int(beyond[0]) if beyond.size else len(sizes)
    return max(first - 1 + first % 2, _FEWEST)  # odd: a square Hankel matrix behind sample 1


class _Runs:
    """Pulse responses, each from the operating point: state restored, or a fresh instance."""

    def __init__(
        self,
        file: FmuFile,
        names: Signals,
        values: Values,
        instance: FmuInstance,
        point: Point,
        step: float,
    ) -> None:
        self.file, self.values, self.point, self.step = file, values, point, step
        self._inputs = file.ports(names.inputs)
        self._seen = file.ports([*names.states, *names.outputs])
        self._instance, self._saved = instance, None
        self.how = "fresh instances"
        if saves_state(file):
            try:
                self._saved = instance.get_state()
                self.how = "state restored"
            except FmuCallError:
                pass  # declared, but not there

    def __call__(self, pulse: Array) -> Array:
        """Return the samples after each step, (samples, states and outputs)."""
        if self._saved is None:
            with self.file.instantiate("pulse") as fresh:
                bring_to(fresh, self.point.time, self.values, self.step)
                return self._run(fresh, pulse)
        self._instance.set_state(self._saved)
        return self._run(self._instance, pulse)

    def _run(self, instance: FmuInstance, pulse: Array) -> Array:
        rows = []
        for k in range(_SAMPLES):
            instance.write(self._inputs, pulse if k == 0 else self.point.u)
            instance.do_step(self.point.time + k * self.step, self.step)
            rows.append(instance.read(self._seen))
        return np.array(rows)


def _realise(
    markov: Array, uncertain: Array, names: Signals, where: str
) -> tuple[Array, Array, Array, Array, float, float]:
    """Return Ad, Bd, C, D, error and relative misfit from the samples of a pulse response.

    The order is the lowest that explains the samples as well as they are known.
    """
    m, p = len(names.states), markov.shape[1]
    scale = np.abs(markov).max(axis=(1, 2), keepdims=True)
    scale[scale == 0] = 1.0  # each signal counts alike
    samples = markov / scale
    known = float((uncertain / scale).max())
    enough = max(_FIT, 2 * known)
    best, misfit, order = _of_order(samples, 0), np.inf, 0
    for k in range(_highest_order(samples) + 1):
        system = _of_order(samples, k)
        off = float(np.abs(_response(*system, samples.shape[2]) - samples).max())
        if off < misfit:
            best, misfit, order = system, off, k
        if misfit <= enough:
            break
    Ad, Bd, Cs, D = best[0], best[1], best[2] * scale[:, 0], best[3] * scale[:, 0]
    D[np.abs(D) <= _REAL * np.abs(markov[:, :, 0]).max(initial=0.0)] = 0.0
    error = max(misfit * float(scale.max()), float(uncertain.max()))
    if m:
        if order != m or np.linalg.cond(Cs[:m]) > 1e10:
            raise FmuError(
                f"expected the inputs to reach all {m} states (they reach {order}); give states "
                "that can be set, or leave them out",
                where,
            )
        T = Cs[:m]
        back = np.linalg.inv(T)
        Ad, Bd, Cs = T @ Ad @ back, T @ Bd, Cs @ back
    return np.asarray(Ad), np.asarray(Bd), Cs[m:], D[m:].reshape(-1, p), error, max(misfit, known)


def _highest_order(samples: Array) -> int:
    """Return the rank of the Hankel matrix, as far as it can be realised."""
    q, p, count = samples.shape
    half = (count - 1) // 2
    blocks = [[samples[:, :, 1 + i + j] for j in range(half)] for i in range(half)]
    s = np.linalg.svd(np.block(blocks), compute_uv=False)
    rank = int((s > _RANK * s[0]).sum())
    return int(min(rank, _LARGEST_ORDER, (half - 1) * min(q, p)))


def _of_order(samples: Array, order: int) -> tuple[Array, Array, Array, Array]:
    """Realise pulse responses with a given order; return Ad, Bd, C, D.

    Sample 1 is C Bd + D: a step holds its input to its end. So the later ones, C Ad^k Bd for
    k ≥ 1, are realised, Bd comes from Ad Bd, and D is what is left of sample 1.
    """
    import control

    q, p, count = samples.shape
    if order == 0:
        return np.zeros((0, 0)), np.zeros((0, p)), np.zeros((q, 0)), samples[:, :, 0].copy()
    # python-control counts a direct term first: here it is left out
    data = samples.copy()
    data[:, :, 0] = 0.0
    half = (count - 1) // 2 - 1
    system, _ = control.eigensys_realization(data, order, m=half, n=half, dt=True)
    Ad, C = np.asarray(system.A), np.asarray(system.C)
    Bd = np.linalg.lstsq(Ad, np.asarray(system.B), rcond=1e-10)[0]
    return Ad, Bd, C, np.asarray(samples[:, :, 0] - C @ Bd)


def _response(Ad: Array, Bd: Array, C: Array, D: Array, count: int) -> Array:
    """Return the samples after each step of a pulse response, (q, p, count)."""
    columns = [Bd]
    for _ in range(count - 1):
        columns.append(Ad @ columns[-1])
    samples = np.stack([C @ column for column in columns], axis=2)
    samples[:, :, 0] += D
    return samples
