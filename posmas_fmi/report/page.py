"""The page: figures, tables and sentences of a run put into the template."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import resources
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from posmas_fmi.expression import Array
from posmas_fmi.report import figures, wording
from posmas_fmi.report.data import Run
from posmas_fmi.report.network_drawing import FEW_NODES, MOST_NODES, names_fit, network_figure
from posmas_fmi.report.svg import BLACK, BLUE, SKY, VERMILION
from posmas_fmi.report.wording import show

if TYPE_CHECKING:
    from markupsafe import Markup

MOST_STATES = 6  # components of which each gets a plot of its own
MOST_HEARD = 8  # names listed in one cell
MOST_RECORDED = 12  # variables recorded besides of which each gets a plot


@attrs.frozen
class Figure:
    """One figure: its panels side by side, with a caption."""

    letter: str
    title: str
    caption: str
    panels: tuple[Markup, ...]
    note: str = ""


@attrs.frozen
class AgentRow:
    """One line of the table of agents."""

    number: int
    name: str
    pinned: bool
    hears: str
    p: str
    status: str
    final_error: str
    estimation_error: str
    lowest: str
    lost_at: str


@attrs.frozen
class Key:
    """One entry of the legend: a line or a patch."""

    text: str
    colour: str
    dash: str
    patch: bool = False


def render(run: Run, kpis: bool = False) -> str:
    """Return the HTML page of a run.

    Parameters
    ----------
    run : Run
    kpis : bool
        Whether a page of key figures lies beside, which is then linked.

    Returns
    -------
    str
        One self-contained document: no script, no reference to anything outside.
    """
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["show"] = show
    files = resources.files(__package__)
    source = files.joinpath("template.html.j2").read_text(encoding="utf-8")
    return environment.from_string(source).render(
        run=run,
        style=_svg(files.joinpath("style.css").read_text(encoding="utf-8")),
        design=run.design,
        summary=run.summary,
        headline=wording.headline(run),
        advice=wording.advice(run),
        tone=wording.tone(run),
        tiles=wording.tiles(run),
        network=_network(run),
        reduced_network=run.N > MOST_NODES,
        numbered=run.N <= MOST_NODES and not names_fit(run),
        beside=run.N <= FEW_NODES and all(len(name) <= 12 for name in run.names),
        agents=_agent_rows(run),
        most_rows=FEW_NODES,
        show_lowest=any(agent.min_state is not None for agent in run.summary.agents),
        legend=_legend(run),
        panels=_panels(run) if run.time.size else (),
        inputs=_inputs(run) if run.time.size else (),
        recorded=_recorded(run) if run.time.size else (),
        not_drawn=tuple(run.recorded)[MOST_RECORDED:],
        baseline=_baseline(run) if run.time.size else None,
        baseline_statement=wording.baseline_statement(run),
        kpis=kpis,
        comparison=None if kpis else _comparison(run.summary.comparison),
        provenance=tuple(_flat(run.manifest)),
        attachments=tuple(_long_texts(run.manifest)),
    )


def _svg(text: str) -> Markup:
    """Mark as safe what ElementTree has serialised, and so escaped, and our own style sheet."""
    from markupsafe import Markup

    return Markup(text)


def _network(run: Run) -> Markup:
    return _svg(network_figure(run, "network", wording.describe_network(run)))


def _agent_rows(run: Run) -> list[AgentRow]:
    """Worst first where the table folds, else in the order of the network."""
    order = np.arange(run.N)
    if run.N > FEW_NODES:
        error = np.where(np.isfinite(run.final_error), run.final_error, np.inf)
        order = np.argsort(-error, kind="stable")
    verdicts = run.summary.agents if len(run.summary.agents) == run.N else None
    estimation = run.estimation_error
    adjacency = run.network.adjacency
    rows = []
    for i in order.tolist():
        heard = adjacency.indices[adjacency.indptr[i] : adjacency.indptr[i + 1]].tolist()
        names = [run.names[j] for j in heard[:MOST_HEARD]]
        more = [f"{len(heard) - MOST_HEARD} more"] if len(heard) > MOST_HEARD else []
        rows.append(
            AgentRow(
                number=i + 1,
                name=run.names[i],
                pinned=bool(run.network.pinning[i] > 0),
                hears=", ".join([*names, *more]),
                p=show(None if run.p_profile is None else float(run.p_profile[i])),
                status=verdicts[i].status if verdicts else "",
                final_error=_last_error(run.tracking_error, i)
                if run.summary.band is None
                else show(float(run.final_error[i])),
                estimation_error=_last_error(estimation, i),
                lowest=show(verdicts[i].min_state) if verdicts else "–",
                lost_at=show(float(run.lost_at[i])) if np.isfinite(run.lost_at[i]) else "",
            )
        )
    return rows


def _last_error(error: Array | None, i: int) -> str:
    """Return the largest modulus of the last error of agent i; a dash where it is not known."""
    if error is None or not len(error) or np.isnan(error[:, i]).all():
        return "–"
    last = float(np.abs(error[-1, i]).max())
    return show(last) if np.isfinite(last) else "not finite"


def _legend(run: Run) -> list[Key]:
    if run.N > figures.MOST_LINES:
        keys = [
            Key("all agents", SKY, "solid", patch=True),
            Key("middle half", BLUE, "solid", patch=True),
            Key("median", BLUE, "solid"),
            Key(f"agent {run.names[run.worst]} (largest final error)", VERMILION, "solid"),
        ]
    else:
        keys = [Key(f"agent {name}", *figures.line_look(i)) for i, name in enumerate(run.names)]
    faults = (
        [Key("a fault holds", figures.FAULT, "solid", patch=True)] if run.summary.faults else []
    )
    return [*keys, Key("leader s", BLACK, "dotted"), *faults]


def _panels(run: Run) -> tuple[Figure, ...]:
    """Build the four panels of the paper's figures 2, 3, 5 and 6."""
    design = run.design
    both = [r for r in (design.rate, design.observer_rate) if r is not None]
    together = min(both) if len(both) == 2 else design.rate

    def per_state(draw: Callable[[int, str, str], str], name: str, what: str, data: Array) -> Any:
        panels = []
        for k in range(min(run.m, MOST_STATES)):
            alt = wording.describe(run, data[:, :, k], f"{what}, state {run.labels['state'][k]}")
            panels.append(_svg(draw(k, f"{name}-{k}", alt)))
        return tuple(panels)

    def states(values: Array, symbol: str, name: str, what: str) -> Any:
        def draw(k: int, name: str, alt: str) -> str:
            return figures.state_panel(run, values, k, symbol, name, alt)

        return per_state(draw, name, what, values)

    def errors(error: Array, symbol: str, rate: float | None, name: str, what: str) -> Any:
        def draw(k: int, name: str, alt: str) -> str:
            return figures.error_panel(run, error, k, symbol, rate, name, alt)

        return per_state(draw, name, what, np.abs(error))

    if run.x is not None:
        a = Figure(
            "a", "Real states", "The states of the plants against the leader s (black, dotted).",
            states(run.x, "x", "x", "Real states"),
        )  # fmt: skip
    else:
        a = Figure(
            "a", "Outputs", "This plant does not show its states; its outputs are drawn instead.",
            tuple(
                _svg(figures.output_panel(run, k, f"y-{k}",
                    wording.describe(run, run.y[:, :, k], f"Output {run.labels['output'][k]}")))
                for k in range(min(run.y.shape[2], MOST_STATES))
            ),
        )  # fmt: skip
    b = Figure(
        "b", "Observer states", "The estimates x̂ of the same states, against the leader.",
        states(run.xhat, "x̂", "xhat", "Observer states"),
    )  # fmt: skip
    scale = "Modulus, logarithmic: a dip is a change of sign, a straight line an exponential."
    if run.N > figures.MOST_LINES:
        scale += (
            f" The palest band leaves out the smallest {100 * figures.LEAST:.0f} %, "
            "which are crossing zero."
        )

    def with_slope(rate: float | None) -> str:
        if rate is None or not rate > 0:
            return scale
        return f"{scale} Grey, dashed: the slope of the proved rate, {show(rate)} 1/s."

    if run.estimation_error is not None:
        c = Figure(
            "c", "Estimation error e = x − x̂", with_slope(design.observer_rate),
            errors(run.estimation_error, "e", design.observer_rate, "e", "Estimation error"),
        )  # fmt: skip
    else:
        c = Figure(
            "c", "Estimation error e = x − x̂", "", (),
            "Not known: the plant does not show its states.",
        )  # fmt: skip
    symbol = "x − s" if run.x is not None else "x̂ − s"
    d = Figure(
        "d", f"Consensus error δ = {symbol}", with_slope(together),
        errors(run.tracking_error, "δ", together, "delta", "Consensus error"),
    )  # fmt: skip
    return (a, b, c, d)


def _inputs(run: Run) -> tuple[Figure, ...]:
    found = []
    for k in range(min(run.p, MOST_STATES)):
        label = run.labels["input"][k]
        what = f"Input {label}"
        panels = [
            _svg(figures.input_panel(run, k, f"u-{k}", wording.describe(run, run.u[:, :, k], what)))
        ]
        statement = wording.sector_statement(run, k)
        if run.sec_u is not None:
            alt = f"sec(u) against u for input {label}, with the sector cone. {statement}"
            panels.append(_svg(figures.sector_panel(run, k, f"sector-{k}", alt)))
        found.append(Figure("", what, statement, tuple(panels)))
    return tuple(found)


def _recorded(run: Run) -> tuple[Markup, ...]:
    """Draw what was recorded besides: signals from outside, variables of FMUs."""
    panels = []
    for k, (name, values) in enumerate(list(run.recorded.items())[:MOST_RECORDED]):
        alt = wording.describe(run, values, f"Recorded variable {name}")
        panels.append(_svg(figures.recorded_panel(run, name, f"recorded-{k}", alt)))
    return tuple(panels)


def _baseline(run: Run) -> Markup | None:
    error = run.baseline_error
    if error is None:
        return None
    largest = np.abs(error).max(axis=(1, 2))
    alt = wording.describe(run, largest, "Largest tracking error with K = 0")
    own = wording.describe(run, np.abs(run.tracking_error).max(axis=(1, 2)), "With the designed K")
    return _svg(figures.baseline_panel(run, "baseline", f"{alt} {own}"))


def _comparison(content: Mapping[str, Any]) -> tuple[list[str], list[tuple[str, list[str]]]] | None:
    """Return headings and rows of the table controller × KPI."""
    rows = {name: kpis for name, kpis in content.items() if isinstance(kpis, dict)}
    if not rows:
        return None
    headings = list(dict.fromkeys(key for kpis in rows.values() for key in kpis))
    return headings, [
        (name, [_value(kpis.get(key)) for key in headings]) for name, kpis in rows.items()
    ]


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return show(value, 6)
    if isinstance(value, list):
        return ", ".join(_value(entry) for entry in value)
    return "–" if value is None else str(value)


def _flat(content: Mapping[str, Any], place: str = "") -> list[tuple[str, str]]:
    """Return the manifest as rows of key and value, nested keys joined by an arrow."""
    rows: list[tuple[str, str]] = []
    for key, value in content.items():
        name = f"{place} › {key}" if place else key
        if isinstance(value, dict):
            rows += _flat(value, name)
        elif not (isinstance(value, str) and "\n" in value):
            rows.append((name, _value(value)))
    return rows


def _long_texts(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(k, v) for k, v in content.items() if isinstance(v, str) and "\n" in v]
