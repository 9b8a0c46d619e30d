"""The parts of a trial: what is done with the FMU, in a process that may not survive it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.errors import ArchiveError, FmuCallError, FmuEndedError, FmuError, PosmasError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.about import About, read_description
from posmas_fmi.fmu.check.journal import Journal, TrialMessages
from posmas_fmi.fmu.check.surroundings import descriptors, resident, threads
from posmas_fmi.fmu.evaluation import default_step, saves_state, start_time
from posmas_fmi.fmu.event_mode import EventFile, needs_event_mode
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.fmi1 import Fmi1File, Fmi1SteppedFile
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.model_exchange import ModelExchangeFile, ModelExchangeInstance
from posmas_fmi.fmu.stepped import SteppedFile
from posmas_fmi.fmu.variables import Ports

_ABSURD = 1e30
_MOST_READ = 2000  # outputs
_STEPS = 50
_PATIENCE = 2.0  # s for the steps of one part
_FEW = 6  # steps that are compared
_EXACT = 1e-12  # relative: rounding
_CLOSE = 1e-6
_LEAK = 64 * 1024  # bytes in each round
_ROUNDS = 4


@attrs.frozen
class Job:
    """What is to be tried.

    Attributes
    ----------
    fmu, unpacked : str
        The file, and where it is unpacked.
    interface : str
        ``"Co-Simulation"`` or ``"Model Exchange"``.
    inputs, outputs : tuple of str
        Of the control report; those that the FMU declares if empty.
    values : dict
        Parameters and start values.
    phases : tuple of str
        Names from `PHASES`.
    single : bool
        Whether only one instance is allowed per process.
    serialises : bool
        Whether states can be serialised.
    major : int
        FMI version.
    """

    fmu: str
    unpacked: str
    interface: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    values: dict[str, Any]
    phases: tuple[str, ...]
    single: bool = False
    serialises: bool = False
    major: int = 2


class Trial:
    """The FMU of a job, loaded, and what is noted about it."""

    def __init__(self, job: Job, journal: Journal) -> None:
        self.job, self.journal = job, journal
        self.messages = TrialMessages(journal)

    @cached_property
    def file(self) -> FmuFile:
        """The FMU; loaded when it is first asked for."""
        path, unpacked = Path(self.job.fmu), Path(self.job.unpacked)
        co_simulation = self.job.interface == "Co-Simulation"
        kind: type[FmuFile] = FmuFile if co_simulation else SteppedFile
        if self.job.major == 1:
            kind = Fmi1File if co_simulation else Fmi1SteppedFile
        elif self.job.major == 3 and needs_event_mode(
            About.of(path, read_description(unpacked, path))
        ):
            kind = EventFile  # clocks tick in Event Mode only: some refuse to start without it
        return kind(path, self.messages, self.journal.call, unpacked)

    def run(self) -> None:
        """Go through the parts."""
        journal = self.journal
        for name in self.job.phases:
            board = journal.board
            board.enter(name, vital=name == "life")
            try:
                PHASES[name](self)
            except FmuEndedError as error:
                journal.told()
                journal.discarded = False
                self._failed(error.message, error.where.rpartition(": ")[2])
            except FmuCallError as error:
                journal.judge_discard()
                if not journal.told():
                    self._failed(error.message, error.where.rpartition(": ")[2])
            except ArchiveError as error:
                journal.note(journal.severity, "not-loaded", "load", error.message[:500])
            except PosmasError as error:
                self._failed(str(error))
            except Exception as error:  # what an odd FMU leads to in the libraries used
                self._failed(f"{type(error).__name__}: {error}")
            if board.vital:  # it did not come to its first step
                break

    def _failed(self, text: str, call: str = "") -> None:
        journal = self.journal
        board = journal.board
        severity, remedy = journal.severity, ""
        if board.phase == "control":
            journal.note("note", "no-control-report", call or board.call, text[:500])
            return
        if text.startswith("the FMU returned no instance"):
            code = "no-instance"
        elif "binary cannot be loaded" in text:
            code = "not-loaded"
            text = text[text.index("the binary cannot be loaded") :]
            if "shared object file" in text:
                remedy = "install that library, or export the FMU with it inside"
        elif "asked to end" in text:
            code = "terminates"
            severity = "fatal" if board.vital else "note"
        elif "returned early" in text:
            code = "stuck"
        else:
            code = f"{board.phase}-failed"
        journal.note(severity, code, call or board.call or board.phase, text[:500], remedy)

    # ---- instances ------------------------------------------------------------------------------

    def started(self, name: str) -> FmuInstance:
        """Return an instance that is initialised."""
        instance = self.file.instantiate(name)
        try:
            self.start(instance)
        except BaseException:
            instance.free()
            raise
        return instance

    def start(self, instance: FmuInstance) -> None:
        """Initialise an instance."""
        instance.initialise(self.job.values, start=self.t0)

    @cached_property
    def t0(self) -> float:
        """Start time [s]."""
        return start_time(self.file)

    @cached_property
    def h(self) -> float:
        """Communication step [s]."""
        return default_step(self.file)

    def step(self, instance: FmuInstance, k: int) -> None:
        """Make the k-th step (from 0)."""
        instance.do_step(self.t0 + k * self.h, self.h)

    @cached_property
    def inputs(self) -> Ports:
        """Ports of the inputs that are real."""
        return self._ports("input", self.job.inputs)

    @cached_property
    def outputs(self) -> Ports:
        """Ports of what is read: outputs that are real and what was asked for."""
        return self._ports("output", self.job.outputs)

    def _ports(self, causality: str, more: Sequence[str]) -> Ports:
        names = [
            v.name
            for v in self.file.variables.values()
            if v.causality == causality and v.type in ("Real", "Float64", "Float32") and v.size
        ]
        known = set(names)
        extra = [name for name in more if name not in known and name.split("[")[0] not in known]
        return self.file.ports([*names[:_MOST_READ], *extra])

    def read(self, instance: FmuInstance) -> Array:
        """Return the outputs, and note what they should not be."""
        ports = self.outputs
        values = np.empty(ports.size)
        if not ports.size:
            return values
        instance.read_whole(ports, values)
        for name, value in zip(ports.names, values[ports.places], strict=True):
            if not np.isfinite(value):
                self.journal.note(
                    "error", "not-finite", name, f"its value is {value} at {instance.time:g} s"
                )
            elif abs(value) > _ABSURD and self.journal.board.phase == "life":
                self.journal.note("warning", "absurd", name, f"its value is {value:g}")
        return values

    def base(self, instance: FmuInstance) -> Array:
        """Return the inputs as they are at the start."""
        ports = self.inputs
        whole = np.empty(ports.size)
        if ports.size:
            instance.read_whole(ports, whole)
        return np.asarray(np.nan_to_num(whole[ports.places], posinf=0.0, neginf=0.0))

    def excite(self, instance: FmuInstance, base: Array, k: int) -> None:
        """Set the inputs to something that changes with the step, within their ranges."""
        ports = self.inputs
        if not ports.size:
            return
        limits = [self._limits(name) for name in ports.names]
        values = base + 0.01 * np.maximum(np.abs(base), 1e-3) * np.sin(
            1.0 + k + np.arange(base.size)
        )
        values = [min(max(v, low), high) for v, (low, high) in zip(values, limits, strict=True)]
        instance.write(ports, values)

    def _limits(self, name: str) -> tuple[float, float]:
        known = {v.name: v for v in self.file.description.modelVariables}
        variable = known.get(name) or known.get(name.split("[")[0])
        low, high = getattr(variable, "min", None), getattr(variable, "max", None)
        return (
            float(low) if low not in (None, "") else -np.inf,
            float(high) if high not in (None, "") else np.inf,
        )

    def response(self, instance: FmuInstance, first: int = 0, count: int = _FEW) -> Array:
        """Return the outputs over a few steps with inputs that change, (count, q)."""
        base, rows = self.base(instance), []
        began = time.monotonic()
        for k in range(first, first + count):
            self.excite(instance, base, k)
            self.step(instance, k)
            rows.append(self.read(instance))
            if time.monotonic() - began > _PATIENCE:
                break
        if self.inputs.size:
            instance.write(self.inputs, base)
        return np.array(rows)


# ---- the parts ----------------------------------------------------------------------------------


def life(trial: Trial) -> None:
    """Load, instantiate, initialise, step, terminate, free; how long things take."""
    journal = trial.journal
    began = time.perf_counter()
    file = trial.file
    loaded = time.perf_counter()
    instance = file.instantiate("check")
    made = time.perf_counter()
    trial.start(instance)
    journal.result(
        load_s=loaded - began,
        instantiate_s=made - loaded,
        initialise_s=time.perf_counter() - made,
        start=trial.t0,
        step=trial.h,
    )
    trial.read(instance)
    times, began = [], time.monotonic()
    base = trial.base(instance)
    for k in range(_STEPS):
        if trial.inputs.size:
            instance.write(trial.inputs, base)
        before = time.perf_counter()
        trial.step(instance, k)
        spent = time.perf_counter() - before
        times.append(spent if isinstance(instance, ModelExchangeInstance) else journal.last)
        journal.board.vital = False
        trial.read(instance)
        if time.monotonic() - began > _PATIENCE:
            break
    journal.result(
        steps=len(times), step_median_s=float(np.median(times)), step_max_s=float(max(times))
    )
    instance.terminate()
    instance.free()


def reset(trial: Trial) -> None:
    """Whether an instance that was reset does the same again."""
    if trial.job.major == 1 and trial.job.interface == "Model Exchange":
        trial.journal.note(
            "note", "no-reset", "Reset", "FMI 1.0 cannot reset a Model Exchange instance"
        )
        return
    with trial.started("reset") as instance:
        first = trial.response(instance)
        instance.reset()
        trial.start(instance)
        off = _difference(first, trial.response(instance))
    trial.journal.result(reset_noise=off)
    if off > _CLOSE:
        trial.journal.note(
            "error",
            "reset-differs",
            "Reset",
            f"after a reset the same steps give other outputs: off by {off:.2g} of their size",
            "a fresh instance is used in place of a reset",
        )


def rollback(trial: Trial) -> None:
    """Whether steps can be done again from a saved state, and how exactly."""
    if trial.job.major == 1:
        text = "FMI 1.0 has no saved states: going back to one was not tried"
        trial.journal.note("note", "no-saved-state", "SetFMUState", text)
    if not saves_state(trial.file):
        return
    with trial.started("rollback") as instance:
        trial.response(instance, 0, 2)
        with instance.get_state() as saved:
            before = trial.read(instance)
            first = trial.response(instance, 2)
            instance.set_state(saved)
            off = _difference(before[None, :], trial.read(instance)[None, :])
            off = max(off, _difference(first, trial.response(instance, 2)))
            _judge_rollback(trial, off)
            if trial.job.serialises:
                trial.journal.board.enter("serialisation")
                instance.set_state(saved)
                data = instance.serialise()
                instance.deserialise(data, saved.time)
                again = _difference(first, trial.response(instance, 2))
                trial.journal.result(serialise_noise=again, state_bytes=len(data))
                if again > max(_CLOSE, 10 * off):
                    trial.journal.note(
                        "error",
                        "serialise-differs",
                        "DeserializeFMUState",
                        f"a serialised state is another one: off by {again:.2g}",
                        "runs cannot be resumed with it",
                    )


def _judge_rollback(trial: Trial, off: float) -> None:
    trial.journal.result(replay_noise=off)
    if off <= _EXACT:
        return
    trial.journal.note(
        "note" if off <= _CLOSE else "warning" if off <= 1e-3 else "error",
        "rollback-noise" if off <= 1e-3 else "rollback-differs",
        "SetFMUState",
        f"steps done again from a saved state are off by {off:.2g} of the outputs' size",
        "tolerances of iterated coupling have to be larger than that",
    )


def second(trial: Trial) -> None:
    """Whether instances beside each other leave each other alone."""
    if trial.job.single:
        return
    alone = [_alone(trial, name) for name in ("first", "again")]
    noise = _difference(*alone)
    trial.journal.result(repeat_noise=noise)
    if noise > _CLOSE:
        trial.journal.note(
            "warning",
            "not-repeatable",
            "DoStep",
            f"two instances with the same inputs differ by {noise:.2g} of the outputs' size",
        )
    rows = []
    with trial.started("one") as one, trial.started("other") as other:
        if one.component == other.component:
            trial.journal.note(
                "error", "instances-share", "Instantiate", "two instances are the same object"
            )
            return
        base = trial.base(one)
        for k in range(len(alone[0])):
            trial.excite(other, base, k + 7)
            trial.excite(one, base, k)
            trial.step(one, k)
            trial.step(other, k)
            rows.append(trial.read(one))
    off = _difference(alone[0], np.array(rows))
    if off > max(_CLOSE, 10 * noise):
        trial.journal.note(
            "error",
            "instances-share",
            "DoStep",
            f"a second instance changes what the first one does: off by {off:.2g}",
            "give each instance a process of its own",
        )


def _alone(trial: Trial, name: str) -> Array:
    with trial.started(name) as instance:
        return trial.response(instance)


def leaks(trial: Trial) -> None:
    """Whether steps, or instances that were freed, leave memory behind."""
    grown = _ROUNDS * [0]
    with trial.started("leaks") as instance:
        k = 0
        for number in range(_ROUNDS):
            before, began = resident(), time.monotonic()
            for _ in range(100):
                trial.step(instance, k)
                trial.read(instance)
                k += 1
                if time.monotonic() - began > _PATIENCE / 4:
                    break
            grown[number] = resident() - before
    _judge_leak(trial, grown, "DoStep", f"{k} steps")
    count = 1 if trial.job.single else 8
    for number in range(_ROUNDS):
        before = resident()
        for _ in range(count):
            trial.started("leaks").free()
        grown[number] = resident() - before
    _judge_leak(trial, grown, "FreeInstance", f"{_ROUNDS * count} instances")
    trial.journal.board.enter("leaks")
    extra = threads() - trial.journal.surroundings.threads
    if extra > 0:
        trial.journal.note(
            "warning",
            "leaves-threads",
            "FreeInstance",
            f"{extra} threads of it go on after all instances were freed",
            "give it a process of its own; it must not be unloaded",
        )
    opened = descriptors() - trial.journal.surroundings.descriptors
    if opened > 0:
        trial.journal.note(
            "warning",
            "leaves-descriptors",
            "FreeInstance",
            f"{opened} file descriptors stay open after all instances were freed",
        )


def _judge_leak(trial: Trial, grown: list[int], place: str, what: str) -> None:
    if min(grown[1:]) > _LEAK:
        trial.journal.note(
            "warning",
            "leak",
            place,
            f"memory grew by {sum(grown) / 2**20:.1f} MiB over {what}, and goes on growing",
            "restart its process from time to time in long runs",
        )


def control(trial: Trial) -> None:
    """Linear model, signs, sectors, time constants, a period: what the design needs to know."""
    from posmas_fmi.fmu.check.control import control_report

    job, report = trial.job, {}
    with _for_control(trial) as file:
        about = trial.file.about
        for part in control_report(file, job.inputs, job.outputs, trial.t0, job.values, about):
            report.update(part)
            trial.journal.result(control=report)


def _for_control(trial: Trial) -> FmuFile:
    """Load the FMU as `linearise` does: for Model Exchange, if it can that."""
    job = trial.job
    arguments = (job.fmu, trial.messages, trial.journal.call, Path(job.unpacked))
    if job.major != 1 and trial.file.description.modelExchange is not None:
        with suppress(FmuError):
            return ModelExchangeFile(*arguments)
    return type(trial.file)(*arguments)


def unload(trial: Trial) -> None:
    """Unload the library, and see that nothing happens."""
    done = trial.journal.call("dlclose")
    trial.file.close()
    time.sleep(0.02)
    done(None)


PHASES: dict[str, Callable[[Trial], None]] = {
    "life": life,
    "reset": reset,
    "rollback": rollback,
    "second": second,
    "leaks": leaks,
    "unload": unload,
    "control": control,
}


def _difference(first: Array, then: Array) -> float:
    """Return the largest difference of outputs, relative to the size of each; NaN if some are."""
    n = min(len(first), len(then))
    if not n or not first.size:
        return 0.0
    both = np.stack([first[:n], then[:n]])
    if not np.isfinite(both).all():
        return float("nan")  # told elsewhere
    size = np.maximum(np.abs(both).max(axis=(0, 1)), 1e-12)
    return float((np.abs(both[0] - both[1]) / size).max(initial=0.0))
