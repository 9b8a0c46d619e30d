"""From the tables of a scenario to instances and their wiring: who is fed by whom."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cosim.fmu_plant import PlantSpec, PortMap, converted
from posmas_fmi.cosim.recorder import TAKEN
from posmas_fmi.cosim.wiring import Extra, NoDrive, Term, Wiring, column
from posmas_fmi.errors import FmuError, InputError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.about import About, fitted
from posmas_fmi.fmu.units import Conversion
from posmas_fmi.scenario.signals import Columns, Signals
from posmas_fmi.scenario.tables import ConnectionTable, Derivatives

AGENTS = "agents"


@attrs.define(eq=False)
class Instance:
    """An instance while its ports are gathered; see `PlantSpec`.

    Attributes
    ----------
    name : str
    about : About
        Its FMU.
    values : mapping
    inputs, readings : PortMap
        Those of the protocol; more are added.
    tolerance : float or None
    extras : dict of str to Extra
        FMU inputs beside those of the protocol.
    rates : dict of str to Extra
        Derivatives of some of these.
    more : list of str
        FMU variables that are read besides.
    first : dict of str to float
        What inputs that follow signals alone are when the run begins: also while the FMU
        initialises, unless `values` has something else.
    """

    name: str
    about: About
    values: Mapping[str, Any]
    inputs: PortMap
    readings: PortMap
    tolerance: float | None = None
    extras: dict[str, Extra] = attrs.field(factory=dict)
    rates: dict[str, Extra] = attrs.field(factory=dict)
    more: list[str] = attrs.field(factory=list)
    first: dict[str, float] = attrs.field(factory=dict)

    def check(self, variable: str, place: str) -> None:
        """Refuse what is no single number of the FMU.

        Raises
        ------
        InputError
        """
        converted(self.about, PortMap.plain((variable,), place))

    def check_input(self, variable: str, place: str) -> None:
        """Refuse what is no single number that may be set while the FMU runs.

        Raises
        ------
        InputError
        """
        self.check(variable, place)
        about, one = self.about, self.about.variable(variable)
        tunable = one.causality == "parameter" and one.variability == "tunable"
        if about.version > 1 and one.causality != "input" and not tunable:
            inputs = [v.name for v in about.variables.values() if v.causality == "input"]
            raise InputError(
                f"{about.path.name}: {variable!r} cannot be set while it runs, its causality is "
                f"{one.causality}; inputs: {', '.join(inputs[:8]) or 'none'}",
                place,
            )

    def wants(self, variable: str) -> int:
        """Place of a variable among the readings, which it is added to if need be."""
        if variable not in self.more:
            self.more.append(variable)
        return len(self.readings.variables) + self.more.index(variable)

    def interpolates(self, variable: str) -> bool:
        """Whether the FMU takes the derivative of an input (FMI 2, canInterpolateInputs)."""
        about = self.about
        able = about.kind == "Co-Simulation" and bool(about.interface.canInterpolateInputs)
        return able and about.version == 2 and about.variable(variable).type == "Real"

    def feed(self, variable: str, extra: Extra, place: str) -> None:
        """Let an input be what it is wired to.

        Raises
        ------
        InputError
            If it is set by something else already.
        """
        by_law = variable in self.inputs.variables
        if by_law or variable in self.extras:
            other = "the control law" if by_law else "another connection or signal"
            raise InputError(
                f"{self.name}: the input {variable!r} is set by {other} already; leave one out",
                place,
            )
        self.extras[variable] = extra

    def spec(self) -> PlantSpec:
        """Return the definition of the instance."""
        first = {name: v for name, v in self.first.items() if not self._has_start(name)}
        return PlantSpec(
            self.about.path,
            {**first, **self.values},
            self.name,
            attrs.evolve(
                converted(self.about, self.inputs) + PortMap.plain(tuple(self.extras)),
                rates=tuple(self.rates),
            ),
            converted(self.about, self.readings) + PortMap.plain(tuple(self.more)),
            self.tolerance,
        )

    def _has_start(self, variable: str) -> bool:
        """Whether a start value is given for a variable, or for the array that it is part of."""
        return variable in self.values or variable.partition("[")[0] in self.values


@attrs.frozen(eq=False)
class Recorded:
    """What the recorded columns are.

    Attributes
    ----------
    of_agents : dict of str to tuple of int
        Column of each agent, by variable; ``agents.x`` where a result has an x of its own.
    of_components : dict of str to int
        Column by ``component.variable``.
    units : dict of str to str
        By the same names, where the FMUs say them and agree.
    """

    of_agents: dict[str, tuple[int, ...]] = attrs.field(factory=dict)
    of_components: dict[str, int] = attrs.field(factory=dict)
    units: dict[str, str] = attrs.field(factory=dict)

    def named(self, values: dict[str, Array]) -> dict[str, Array]:
        """Give the columns of ``extra``, (r, columns), their names; other arrays stay."""
        extra = values.get("extra")
        rest = {name: value for name, value in values.items() if name != "extra"}
        if extra is None:
            return rest
        agents = {name: extra[:, list(at)] for name, at in self.of_agents.items()}
        return rest | agents | {name: extra[:, at] for name, at in self.of_components.items()}


def _label(name: str) -> str:
    """Return a name that NetCDF takes: there a slash is a folder."""
    return name.replace("/", "|")


def _placed(make: Callable[[], Conversion], place: str) -> Conversion:
    """Give errors of a conversion their place."""
    try:
        return make()
    except (FmuError, InputError) as error:
        raise InputError(error.message, place) from None


def _weights(table: ConnectionTable, sources: int, place: str) -> list[float]:
    """Scale of each source of a connection."""
    if not isinstance(table.scale, list):
        return [1.0 if table.scale is None else table.scale] * sources
    if not table.sum:
        raise InputError("expected a number; a list is for sum = true, one for each agent", place)
    if len(table.scale) != sources:
        raise InputError(
            f"expected {sources} numbers, one for each agent (got {len(table.scale)})", place
        )
    return table.scale


@attrs.frozen
class _Reading:
    instance: int
    variable: str


class Wires:
    """Gathers what is wired to what, and then gives every reading its place.

    Parameters
    ----------
    agents, components : list of Instance
    columns : mapping of str to Columns
        Where each signal stands.
    every : sequence of int
        Period of each instance in communication steps.
    derivatives : {"none", "signals", "all"}
        Of which inputs FMUs are told how they go on during a step, where they interpolate: those
        that follow a signal that is linear, or those that are connected as well.
    """

    def __init__(
        self,
        agents: list[Instance],
        components: list[Instance],
        columns: Mapping[str, Columns],
        every: Sequence[int] = (),
        derivatives: Derivatives = "none",
    ) -> None:
        self._every, self._derivatives = every, derivatives
        self._rates: dict[tuple[int, int], int] = {}  # columns of rates, by column and steps
        self._first_rate = sum(one.count for one in columns.values())
        self._with_rate: dict[tuple[int, str], list[tuple[_Reading | int, float]]] = {}
        self._agents, self._all = agents, [*agents, *components]
        self._columns = columns
        self._number = {one.name: k for k, one in enumerate(self._all)}
        self._terms: list[tuple[int, str, list[tuple[_Reading | int, float]], float, str]] = []
        self._units: dict[tuple[About, About, str, str], Conversion] = {}
        self._measured: list[list[_Reading | int]] = []

    def exogenous(self, instance: int, inputs: Mapping[str, str], place: str) -> None:
        """Let inputs of an instance follow signals.

        Raises
        ------
        InputError
            If there is no such signal or input, their units do not fit, or it does not say which
            column is meant.
        """
        for variable, signal in inputs.items():
            where = f"{place}.{variable}"
            if signal not in self._columns:
                known = ", ".join(self._columns) or "none"
                raise InputError(f"there is no signal {signal!r} in [signals] ({known})", where)
            self._all[instance].check_input(variable, where)
            found = self._columns[signal]
            count = found.count
            if count > 1 and instance >= len(self._agents):
                raise InputError(
                    f"the signal {signal!r} has {count} columns, one for each agent; a component "
                    "needs one of a single column",
                    where,
                )
            source = column(found.first + (instance if count > 1 else 0))
            unit = self._from_signal(found.unit, instance, variable, where)
            self._terms.append((instance, variable, [(source, unit.scale)], unit.offset, where))
            goes_on = found.linear and self._derivatives != "none"
            if goes_on and self._all[instance].interpolates(variable):
                rate = self._rate_of(-1 - source, int(self._every[instance]))
                self._with_rate[instance, variable] = [(rate, unit.scale)]

    def _rate_of(self, signal: int, steps: int) -> int:
        """Source that is the rate of change of a column over so many communication steps."""
        number = self._rates.setdefault((signal, steps), len(self._rates))
        return column(self._first_rate + number)

    def measure(self, sources: Mapping[str, str], place: str) -> None:
        """Let every agent measure more than y: signals, readings of its FMU or of a component's.

        Parameters
        ----------
        sources : mapping of str to str
            By what the law calls it, in the order of the law.
        place : str

        Raises
        ------
        InputError
            If it is not clear which component is meant.
        """
        for name, source in sources.items():
            if source in self._columns:
                found = self._columns[source]
                ends: list[_Reading | int] = [
                    column(found.first + (k if found.count > 1 else 0))
                    for k in range(len(self._agents))
                ]
            elif source.partition(".")[0] in self._number:
                (instance,), variable = self._end(source, f"{place}.{name}")
                ends = [_Reading(instance, variable)] * len(self._agents)
            else:
                ends = [_Reading(k, source) for k in range(len(self._agents))]
            for end in dict.fromkeys(ends):
                if isinstance(end, _Reading):
                    self._all[end.instance].check(end.variable, f"{place}.{name}")
            self._measured.append(ends)

    def connect(self, table: ConnectionTable, place: str) -> None:
        """Let what some instances show be inputs of others.

        Raises
        ------
        InputError
            If a name is unknown, units do not fit, or it is not clear which goes where.
        """
        sources, text = self._end(table.source, f"{place}.source")
        targets, to = self._end(table.to, f"{place}.to")
        n = len(self._agents)
        readings = [_Reading(k, text.replace("{agent}", str(k + 1))) for k in sources]
        for reading in readings:
            self._all[reading.instance].check(reading.variable, f"{place}.source")
        weights = _weights(table, len(readings), f"{place}.scale")
        own = dict(zip(readings, weights, strict=True))

        def add(target: int, variable: str, chosen: list[_Reading]) -> None:
            self._all[target].check_input(variable, f"{place}.to")
            bias, terms = 0.0 if table.offset is None else table.offset, []
            for reading in chosen:
                weight = own[reading]
                if table.scale is None and table.offset is None:
                    unit = self._unit(reading, target, variable, place)
                    weight, bias = unit.scale, bias + unit.offset
                terms.append((reading, weight))
            self._terms.append((target, variable, list(terms), bias, place))
            steady = all(self._every[i] == 1 for i in (target, *(r.instance for r in chosen)))
            wanted = self._derivatives == "all" and steady
            if wanted and self._all[target].interpolates(variable):
                self._with_rate[target, variable] = list(terms)

        if table.sum:
            if "{agent}" in to:
                raise InputError("a sum goes to one input: leave {agent} out", f"{place}.to")
            for target in targets:
                add(target, to, readings)
        elif len(sources) == 1:
            for target in targets:
                add(target, to.replace("{agent}", str(target + 1)), readings)
        elif targets == sources:
            for target, reading in zip(targets, readings, strict=True):
                add(target, to.replace("{agent}", str(target + 1)), [reading])
        elif "{agent}" in to:
            for k, reading in enumerate(readings):
                add(targets[0], to.replace("{agent}", str(k + 1)), [reading])
        else:
            raise InputError(
                f"this would set one input {n} times; add sum = true, or {{agent}} to the input's "
                "name",
                f"{place}.to",
            )

    def _from_signal(
        self, unit: str | None, instance: int, variable: str, place: str
    ) -> Conversion:
        if unit is None:
            return Conversion()
        return _placed(lambda: self._all[instance].about.conversion(variable, unit), place)

    def _unit(self, source: _Reading, target: int, variable: str, place: str) -> Conversion:
        """How what is read becomes the input; asked once for equal FMUs."""
        ends = (self._all[source.instance].about, self._all[target].about)
        key = (*ends, source.variable, variable)
        if key not in self._units:
            self._units[key] = _placed(
                lambda: fitted((ends[0], source.variable), (ends[1], variable)), place
            )
        return self._units[key]

    def _end(self, text: str, place: str) -> tuple[list[int], str]:
        name, dot, variable = text.partition(".")
        if not dot or not variable:
            raise InputError(f'expected "agents.VARIABLE" or "NAME.VARIABLE" (got {text!r})', place)
        if name == AGENTS:
            return list(range(len(self._agents))), variable
        if name not in self._number:
            known = ", ".join(one.name for one in self._all[len(self._agents) :]) or "none"
            raise InputError(
                f"there is no agent or component {name!r} (components: {known})", place
            )
        return [self._number[name]], variable

    def wiring(
        self,
        record: list[str],
        component_record: list[list[str]],
        signals: Signals | None,
    ) -> tuple[Wiring, Recorded]:
        """Give all readings their places; no more can be wired after that.

        Parameters
        ----------
        record : list of str
            Variables of the agents that are recorded.
        component_record : list of list of str
            And of each component.
        signals : Signals, optional
        """
        n = len(self._agents)
        wanted = [_Reading(k, name) for name in record for k in range(n)]
        of_component = [
            _Reading(n + k, name) for k, names in enumerate(component_record) for name in names
        ]
        recorded = [*wanted, *of_component]
        for reading in recorded:
            k = reading.instance - n
            place_of = "$.plant.record" if k < 0 else f"$.component[{k}].record"
            self._all[reading.instance].check(reading.variable, place_of)
        local: dict[_Reading, int] = {}
        in_terms = [s for _, _, terms, _, _ in self._terms for s, _ in terms]
        in_terms += [source for ends in self._measured for source in ends]
        for reading in (*recorded, *(s for s in in_terms if isinstance(s, _Reading))):
            local[reading] = self._all[reading.instance].wants(reading.variable)
        widths = [len(one.readings.variables) + len(one.more) for one in self._all]
        at = np.concatenate([[0], np.cumsum(widths)])

        def place(source: _Reading | int) -> int:
            return source if isinstance(source, int) else int(at[source.instance] + local[source])

        drive = NoDrive() if signals is None else signals
        at_first = drive.rows(0, 1)[0]
        for instance, variable, terms, bias, where in self._terms:
            if all(isinstance(s, int) for s, _ in terms):
                value = bias + sum(w * at_first[-1 - place(s)] for s, w in terms)
                self._all[instance].first[variable] = float(value)
            rate = self._with_rate.get((instance, variable))
            extra = Extra(tuple(Term(place(s), w) for s, w in terms), bias, has_rate=bool(rate))
            self._all[instance].feed(variable, extra, where)
            if rate:
                rates = tuple(Term(place(s), w) for s, w in rate)
                self._all[instance].rates[variable] = Extra(rates, is_rate=True)
        if signals is not None and self._rates:
            drive = attrs.evolve(signals, rates=tuple(self._rates))
        measured = [[place(source) for source in ends] for ends in self._measured]
        wiring = Wiring(
            tuple((*one.extras.values(), *one.rates.values()) for one in self._all),
            np.array(measured, dtype=np.int64).reshape(len(measured), n).T,
            tuple(place(reading) for reading in recorded),
            drive,
        )
        of_agents = {
            _label(f"agents.{name}" if name in TAKEN else name): tuple(range(k * n, (k + 1) * n))
            for k, name in enumerate(record)
        }
        of_components = {
            _label(f"{self._all[r.instance].name}.{r.variable}"): len(wanted) + k
            for k, r in enumerate(of_component)
        }
        units: dict[str, str] = {}
        for name, columns in {**of_agents, **{n: (k,) for n, k in of_components.items()}}.items():
            told = {self._told_unit(recorded[column]) for column in columns}
            if len(told) == 1 and (unit := told.pop()):
                units[name] = unit
        return wiring, Recorded(of_agents, of_components, units)

    def _told_unit(self, reading: _Reading) -> str | None:
        return self._all[reading.instance].about.variable(reading.variable).unit
