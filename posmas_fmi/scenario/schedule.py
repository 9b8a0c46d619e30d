"""The schedule of a run as data: what is done in a communication step, who is fed, how late."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cosim.fmu_plant import PlantSpec
from posmas_fmi.errors import InputError
from posmas_fmi.fmu.about import About, read_about
from posmas_fmi.scenario.build import Scenario
from posmas_fmi.scenario.plant import Instances, fmu_files, make_instances
from posmas_fmi.scenario.signals import Columns

MANY = 6  # names that are printed of a long list
EDGES = 200  # edges


@attrs.frozen
class Action:
    """One thing that the master does in a communication step.

    Attributes
    ----------
    do : str
        ``read``, ``measure``, ``send``, ``control``, ``set``, ``step``, ``save``, ``restore``.
    who : tuple of str
        Agents and components.
    detail : str
    """

    do: str
    who: tuple[str, ...]
    detail: str = ""


@attrs.frozen
class Edge:
    """One thing that an instance is fed with.

    Attributes
    ----------
    source : str
        ``instance.variable``, ``signal NAME`` or ``controller``.
    target : str
        ``instance.variable``.
    delay : int
        Communication steps between the time at which the source has a value and that from which
        on the input has it.
    feedthrough : bool
        Whether the source follows inputs of its FMU at once, or may: the value is then a step
        older still than the delay says.
    ramp : bool
        Whether the input goes on linearly during the step, by its derivative, else it is held.
    """

    source: str
    target: str
    delay: int
    feedthrough: bool
    ramp: bool = False


@attrs.frozen
class Schedule:
    """What happens in each communication step, in this order.

    Attributes
    ----------
    period : float
        Communication step [s].
    actions : tuple of Action
    edges : tuple of Edge
        Beside the network of the agents.
    loops : tuple of tuple of str
        Instances that feed each other in a circle.
    algebraic : tuple of tuple of str
        Variables that follow each other at once in a circle: ``instance.variable``, each of which
        follows the one before it, and the first one the last. One circle for each such group.
    every : dict of str to int
        Instances with a longer period, in communication steps.
    """

    period: float
    actions: tuple[Action, ...]
    edges: tuple[Edge, ...]
    loops: tuple[tuple[str, ...], ...]
    algebraic: tuple[tuple[str, ...], ...]
    every: dict[str, int]

    def to_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return attrs.asdict(self)

    def to_text(self) -> str:
        """Return it for people."""
        lines = [f"communication step {self.period:g} s; at each communication point:"]
        for k, action in enumerate(self.actions, 1):
            detail = f" ({action.detail})" if action.detail else ""
            lines.append(f"  {k}. {action.do:8} {_few(action.who)}{detail}")
        if self.every:
            lines.append("longer periods:")
            lines += [f"  {name}: every {n} steps" for name, n in self.every.items()]
        if self.edges:
            lines.append("beside the network:")
            for edge in self.edges[:EDGES]:
                late = f"{edge.delay} step{'s' if edge.delay != 1 else ''} late"
                more = ", and its source follows inputs at once" if edge.feedthrough else ""
                more += ", going on linearly during the step" if edge.ramp else ""
                lines.append(f"  {edge.source} -> {edge.target}: {late}{more}")
            if len(self.edges) > EDGES:
                lines.append(f"  and {len(self.edges) - EDGES} more (all with --json)")
        for loop in self.loops:
            lines.append(f"loop: {_few(loop)} {'act on each other' if loop[1:] else 'on itself'}")
        iterated = any(action.do == "restore" for action in self.actions)
        how = "repeated until it settles" if iterated else "broken by what comes a step late"
        for loop in self.algebraic:
            lines.append(f"algebraic loop, {how}: {' -> '.join((*loop, loop[0]))}")
        return "\n".join(lines)


def schedule_of(scenario: Scenario, measured: tuple[str, ...] = ()) -> Schedule:
    """Return the schedule of a scenario without running it.

    Parameters
    ----------
    scenario : Scenario
    measured : tuple of str
        What the law measures beside y.

    Raises
    ------
    PosmasError
        As `make_schedule`, or if the FMUs or the wiring do not fit.
    """
    files = fmu_files(scenario)
    abouts = {path: read_about(path) for path in dict.fromkeys(files)}
    return make_schedule(
        scenario, make_instances(scenario, files, measured), [abouts[path] for path in files]
    )


def make_schedule(scenario: Scenario, instances: Instances, abouts: list[About]) -> Schedule:
    """Return the schedule of a run, and check that the FMUs allow it.

    Parameters
    ----------
    scenario : Scenario
    instances : Instances
    abouts : list of About
        What the FMU of each instance says about itself.

    Raises
    ------
    InputError
        If steps are to be repeated and an FMU cannot go back.
    """
    names = tuple(spec.name for spec in instances.specs)
    N, coupling = scenario.network.N, scenario.settings.coupling
    agents, components = names[:N], names[N:]
    if coupling == "iterate":
        _require_rollback(names, abouts)
    late = {name: k + 1 if coupling == "gauss-seidel" else 0 for k, name in enumerate(components)}
    actions = [
        Action("read", names, "outputs, then states where they are shown"),
        Action("measure", agents, "through the sensors, with what else is measured"),
        Action("send", agents, "over the arcs; what has arrived is held, else the last message"),
        Action("control", agents, "equation (6) and the observer, or another law"),
    ]
    stages = [agents, *((name,) for name in components)] if any(late.values()) else [names]
    if coupling == "iterate":
        actions.append(Action("save", names, "states of the FMUs"))
    for stage in stages:
        actions.append(Action("set", stage, "inputs, held over the step"))
        actions.append(Action("step", stage))
    if coupling == "iterate":
        actions.append(
            Action("restore", names, "and set, step and read again, until readings stay")
        )
    return Schedule(
        scenario.clock.h,
        tuple(actions),
        tuple(_edges(instances, abouts, late, coupling, scenario.signal_columns)),
        _loops(instances),
        _algebraic(instances, abouts),
        {name: int(n) for name, n in zip(names, instances.every, strict=True) if n > 1},
    )


def _require_rollback(names: tuple[str, ...], abouts: list[About]) -> None:
    for name, about in zip(names, abouts, strict=True):
        if not getattr(about.interface, "canGetAndSetFMUstate", False):
            raise InputError(
                f"{name}: {about.path.name} cannot give and take back its state, so its steps "
                'cannot be repeated; take coupling = "jacobi" or "gauss-seidel"',
                "$.scenario.coupling",
            )


def _owner(instances: Instances) -> tuple[Any, list[PlantSpec]]:
    widths = [len(spec.readings.variables) for spec in instances.specs]
    return np.concatenate([[0], np.cumsum(widths)]), list(instances.specs)


@attrs.frozen
class _Feed:
    """One term of an input; where the source is -1, the variable is the column of a signal."""

    source: int
    variable: str
    target: int
    to: str
    ramp: bool


def _feeds(instances: Instances) -> list[_Feed]:
    at, specs = _owner(instances)
    found = []
    for target, all_extras in enumerate(instances.wiring.extras):
        inputs = specs[target].inputs.variables
        extras = [extra for extra in all_extras if not extra.is_rate]
        first = len(inputs) - len(extras)
        for k, extra in enumerate(extras):
            for term in extra.terms:
                source, variable = -1, str(-1 - term.source)
                if term.source >= 0:
                    source = int(np.searchsorted(at, term.source, side="right")) - 1
                    variable = specs[source].readings.variables[term.source - int(at[source])]
                found.append(_Feed(source, variable, target, inputs[first + k], extra.has_rate))
    return found


def _edges(
    instances: Instances,
    abouts: list[About],
    late: dict[str, int],
    coupling: str,
    columns: Mapping[str, Columns],
) -> list[Edge]:
    edges = []
    signals = {
        str(found.first + k): name if found.count == 1 else f"{name}[{k + 1}]"
        for name, found in columns.items()
        for k in range(found.count)
    }
    names = [spec.name for spec in instances.specs]
    for feed in _feeds(instances):
        end = f"{names[feed.target]}.{feed.to}"
        if feed.source < 0:
            edges.append(Edge(f"signal {signals[feed.variable]}", end, 0, False, feed.ramp))
            continue
        earlier = late.get(names[feed.source], 0) < late.get(names[feed.target], 0)
        known_at_end = earlier or coupling == "iterate"
        edges.append(
            Edge(
                f"{names[feed.source]}.{feed.variable}",
                end,
                0 if known_at_end else 1,
                feeds_through(abouts[feed.source], feed.variable),
                feed.ramp,
            )
        )
    return edges


def feeds_through(about: About, variable: str) -> bool:
    """Whether a variable follows an input of the FMU at once, or may; see `followed`."""
    return bool(followed(about, variable))


def followed(about: About, variable: str) -> frozenset[str]:
    """Return the inputs of the FMU that a variable follows at once, by its model structure.

    All of them where that says nothing, as about local variables that are no states.

    Parameters
    ----------
    about : About
    variable : str
        Its name, or that of an element.

    Returns
    -------
    frozenset of str
        Names of inputs; of the whole array of an element.
    """
    whole, told = about.variable(variable), about.description
    if whole.causality == "input":
        return frozenset({whole.name})
    if whole.variability in ("constant", "fixed", "tunable"):
        return frozenset()
    for unknown in (*told.outputs, *told.derivatives):
        state = getattr(unknown.variable, "derivative", None)
        if state is not None and state.name == whole.name:
            return frozenset()
        if unknown.variable.name == whole.name and unknown.dependencies is not None:
            return frozenset(v.name for v in unknown.dependencies if v.causality == "input")
    return frozenset(v.name for v in about.variables.values() if v.causality == "input")


def _loops(instances: Instances) -> tuple[tuple[str, ...], ...]:
    import networkx

    graph = networkx.DiGraph()
    for feed in _feeds(instances):
        if feed.source >= 0:
            graph.add_edge(feed.source, feed.target)
    names = [spec.name for spec in instances.specs]
    groups = [sorted(group) for group in networkx.strongly_connected_components(graph)]
    loops = [g for g in groups if len(g) > 1 or graph.has_edge(g[0], g[0])]
    return tuple(tuple(names[k] for k in loop) for loop in sorted(loops))


def _algebraic(instances: Instances, abouts: list[About]) -> tuple[tuple[str, ...], ...]:
    """One circle of variables for each group of them that follow each other at once."""
    import networkx

    names = [spec.name for spec in instances.specs]
    graph = networkx.DiGraph()
    fed: dict[int, list[tuple[str, str]]] = {}  # inputs of each instance: whole, element
    feeds = [feed for feed in _feeds(instances) if feed.source >= 0]
    for feed in feeds:
        graph.add_edge((feed.source, feed.variable), (feed.target, feed.to))
        fed.setdefault(feed.target, []).append(
            (abouts[feed.target].variable(feed.to).name, feed.to)
        )
    for source, variable in {(feed.source, feed.variable) for feed in feeds}:
        at_once = followed(abouts[source], variable)
        for whole, element in fed.get(source, ()):
            if whole in at_once:
                graph.add_edge((source, element), (source, variable))
    circles = []
    for group in networkx.strongly_connected_components(graph):
        if len(group) > 1:
            edges = networkx.find_cycle(graph.subgraph(group), min(group))
            circle = [node for node, _ in edges]
            first = circle.index(min(circle))
            circle = [*circle[first:], *circle[:first]]
            circles.append(tuple(f"{names[k]}.{variable}" for k, variable in circle))
    return tuple(sorted(circles))


def _few(names: tuple[str, ...]) -> str:
    if len(names) <= MANY:
        return ", ".join(names)
    return f"{', '.join(names[: MANY - 1])}, … ({len(names)} in all)"
