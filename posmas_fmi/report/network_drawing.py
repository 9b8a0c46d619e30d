"""The digraph: arrows along which messages go, the leader, the pinned agents, the final errors."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np
import scipy.sparse.csgraph as csgraph

from posmas_fmi.expression import Array
from posmas_fmi.network import Network
from posmas_fmi.report.data import Run
from posmas_fmi.report.svg import BLACK, BLUE, GREY, VERMILION, look, power_of_ten, to_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FEW_NODES = 12  # agents up to which the drawing stands beside the table
MOST_NODES = 60  # agents up to which the digraph itself is drawn
MOST_DOTS = 4000  # arcs up to which each is a dot in the adjacency; beyond, cells are counted
CELLS = 120
COLOURS = "cividis_r"  # even to readers with any colour vision; dark is a large error


@attrs.frozen
class _Scale:
    """Colours for final errors: logarithmic, from the largest error at the start downwards."""

    high: float
    decades: int = 6

    @property
    def low(self) -> float:
        return self.high * 10.0**-self.decades

    def exceeded(self, error: float) -> bool:
        """Whether an error is far larger than what the run started with."""
        return not error <= 10 * self.high  # NaN as well

    def __call__(self, error: float) -> tuple[Any, str]:
        """Return the fill and a text colour readable on it."""
        import matplotlib

        if self.exceeded(error):
            return VERMILION, "white"
        part = 1 + math.log10(min(max(error, self.low), self.high) / self.high) / self.decades
        r, g, b, _ = matplotlib.colormaps[COLOURS](part)
        return (r, g, b), "white" if 0.299 * r + 0.587 * g + 0.114 * b < 0.55 else BLACK


def _scale(run: Run) -> _Scale:
    first = np.abs(run.tracking_error[:1])
    largest = run.summary.band or float(first[np.isfinite(first)].max(initial=0.0)) or 1.0
    return _Scale(10.0 ** math.ceil(math.log10(min(max(largest, 1e-200), 1e200)) - 1e-9))


def _of_what(run: Run) -> str:
    if run.summary.band is not None:
        return " of the supply [K]"
    return " |x − s|" if run.x is not None else " |x̂ − s|"


def network_figure(run: Run, name: str, alt: str) -> str:
    """Draw the digraph, or a summary of it for more than `MOST_NODES` agents.

    Parameters
    ----------
    run : Run
    name, alt : str
        As for `posmas_fmi.report.svg.to_svg`.

    Returns
    -------
    str
        An ``<svg>`` element.
    """
    with look():
        figure = _summary(run) if run.N > MOST_NODES else _digraph(run)
        return to_svg(figure, name, alt)


def names_fit(run: Run) -> bool:
    """Whether the nodes can carry the names of the agents; else they carry numbers from 1."""
    return all(len(name) <= 3 for name in run.names)


def hops(network: Network) -> Array:
    """Return the fewest arcs from the leader to each agent, (N,): infinite if unreached."""
    pinned = list(network.pinned)
    if not pinned:
        return np.full(network.N, np.inf)
    heard_by = network.adjacency.T.tocsr()
    found = csgraph.dijkstra(heard_by, unweighted=True, indices=pinned, min_only=True)
    return np.asarray(found) + 1.0


def layout(network: Network) -> Array:
    """Positions of the agents and, last, of the leader, (N + 1, 2): no randomness.

    Graph distances become distances on paper (Kamada and Kawai, 1989). The longer axis then lies
    flat, with the leader to the left.
    """
    import networkx

    n = network.N
    graph = networkx.Graph()
    graph.add_nodes_from(range(n + 1))
    source, target = network.adjacency.nonzero()
    graph.add_edges_from(zip(source.tolist(), target.tolist(), strict=True))
    graph.add_edges_from((n, i) for i in network.pinned)
    # agents without any arc still need a place
    parts = [sorted(part) for part in networkx.connected_components(graph)]
    graph.add_edges_from((n, part[0]) for part in parts if n not in part)
    start = networkx.circular_layout(graph)
    places = networkx.kamada_kawai_layout(graph, pos=start)
    xy = np.array([places[i] for i in range(n + 1)])
    xy -= xy.mean(axis=0)
    _, _, axes = np.linalg.svd(xy, full_matrices=False)
    if len(axes) < 2:
        axes = np.eye(2)
    xy = xy @ axes.T
    xy[:, 0] *= 1.0 if xy[n, 0] <= 0 else -1.0
    xy[:, 1] *= 1.0 if xy[:n, 1].sum() >= 0 else -1.0
    return np.asarray(xy)


def _nearest(xy: Array) -> float:
    distance = np.hypot(*(xy[:, None, :] - xy[None, :, :]).transpose(2, 0, 1))
    return float(distance[~np.eye(len(xy), dtype=bool)].min())


def _digraph(run: Run) -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.patches import FancyArrowPatch

    network, xy = run.network, layout(run.network)
    n = network.N
    spread = np.ptp(xy, axis=0)
    width = 5.2 if n <= FEW_NODES else 7.4
    foot = 0.75  # of the colour scale
    xy = xy * (width - 1.3) / max(spread[0], 1e-9)  # now in inches
    radius = min(0.24, 0.36 * _nearest(xy))
    height = float(np.clip(np.ptp(xy[:, 1]) + 4 * radius, 1.6, 5.2)) + foot
    figure = Figure(figsize=(width, height))
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, foot / height, 1.0, 1.0 - foot / height))
    axes.set_axis_off()
    axes.set_aspect("equal")
    middle = 0.5 * (xy.max(axis=0) + xy.min(axis=0))
    axes.set_xlim(middle[0] - width / 2, middle[0] + width / 2)
    reach = (height - foot) / 2
    half = max(reach, np.ptp(xy[:, 1]) / 2 + 2 * radius)
    axes.set_ylim(middle[1] - half, middle[1] + half)

    adjacency = network.adjacency.tocoo()
    both = set(zip(adjacency.row.tolist(), adjacency.col.tolist(), strict=True))
    rim = 72 * radius * np.where(np.append(network.pinning, 1.0) > 0, 1.28, 1.0) + 2  # points
    arcs = [(j, i, False) for i, j in sorted(both)] + [(n, i, True) for i in network.pinned]
    for source, target, pin in arcs:
        bend = 0.18 if (source, target) in both and (target, source) in both else 0.0
        if not bend and not pin and _passes_a_node(xy, source, target, radius):
            bend = 0.3
        axes.add_patch(
            FancyArrowPatch(
                tuple(xy[source]),
                tuple(xy[target]),
                arrowstyle="-|>,head_length=0.5,head_width=0.22",
                mutation_scale=9 if n <= 30 else 6,
                connectionstyle=f"arc3,rad={bend}",
                shrinkA=float(rim[source]),
                shrinkB=float(rim[target]),
                lw=1.8 if pin else 0.9,
                color=BLUE if pin else "#7c8594",
            )
        )
    scale = _scale(run)
    _nodes(axes, run, xy, radius, scale)
    _key(figure, run, scale, height)
    return figure


def _passes_a_node(xy: Array, source: int, target: int, radius: float) -> bool:
    """Whether a straight arc would run under a node that it does not belong to."""
    way = xy[target] - xy[source]
    length = max(float(np.hypot(*way)), 1e-9)
    rest = xy - xy[source]
    along = rest @ way / length
    beside = np.abs(rest[:, 0] * way[1] - rest[:, 1] * way[0]) / length
    hit = (beside < 1.05 * radius) & (along > 0) & (along < length)
    hit[[source, target]] = False
    return bool(hit.any())


def _nodes(axes: Axes, run: Run, xy: Array, radius: float, scale: _Scale) -> None:
    from matplotlib.patches import Circle, RegularPolygon

    n = run.N
    fits = names_fit(run)
    size = min(10.0, 62 * radius)
    for i in range(n):
        fill, ink = scale(run.final_error[i])
        if run.network.pinning[i] > 0:
            axes.add_patch(Circle(tuple(xy[i]), 1.28 * radius, fc="white", ec=BLUE, lw=1.8))
        axes.add_patch(Circle(tuple(xy[i]), radius, fc=fill, ec=BLACK, lw=0.8))
        label = run.names[i] if fits else str(i + 1)
        axes.text(
            xy[i, 0], xy[i, 1], label, color=ink, ha="center", va="center_baseline", fontsize=size
        )
    axes.add_patch(RegularPolygon(tuple(xy[n]), 4, radius=1.25 * radius, fc=BLACK, ec=BLACK))
    axes.text(
        xy[n, 0], xy[n, 1], "s", color="white", ha="center", va="center_baseline", fontsize=size
    )


def _key(figure: Figure, run: Run, scale: _Scale, height: float) -> None:
    """Draw the colour scale, in steps so that it stays vector graphics, each over the last."""
    from matplotlib.patches import Rectangle

    axes = figure.add_axes((0.3, 0.36 / height, 0.4, 0.13 / height))
    steps = 48
    for k in range(steps):
        part = (k + 0.5) / steps
        fill, _ = scale(scale.low * (scale.high / scale.low) ** part)
        axes.add_patch(Rectangle((k / steps, 0), 1 - k / steps, 1, fc=fill, lw=0))
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    axes.set_yticks([])
    axes.grid(False)
    axes.spines[:].set_visible(False)
    start = "as at the start" if run.summary.band is None else "the band [K]"
    axes.set_xticks(
        [0, 1], [f"≤ {power_of_ten(scale.low)}", f"{power_of_ten(scale.high)}, {start}"]
    )
    axes.tick_params(length=0, pad=2)
    beyond = any(scale.exceeded(e) for e in run.final_error)
    more = "; vermilion: ten times that" if beyond and run.summary.band is not None else ""
    if beyond and run.summary.band is None:
        more = "; vermilion: larger than at the start"
    axes.set_title(f"final error{_of_what(run)}{more}", loc="center", fontweight="normal", pad=3)


def _summary(run: Run) -> Figure:
    """Adjacency ordered by distance from the leader; final error against that distance."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.4, 3.7))
    left, right = figure.subplots(1, 2)
    network, distance = run.network, hops(run.network)
    profile = run.p_profile
    order = np.lexsort((distance if profile is None else profile, distance))
    place = np.empty(run.N, dtype=int)
    place[order] = np.arange(1, run.N + 1)
    adjacency = network.adjacency.tocoo()
    heard, hearing = place[adjacency.col], place[adjacency.row]
    if adjacency.nnz <= MOST_DOTS:
        size = float(np.clip(300 / run.N, 0.8, 3))
        left.plot(heard, hearing, ls="none", marker="s", ms=size, mew=0, color=BLUE)
    else:
        edges = np.linspace(0.5, run.N + 0.5, min(run.N, CELLS) + 1)
        count, _, _ = np.histogram2d(hearing, heard, bins=(edges, edges))
        count[count == 0] = np.nan
        left.imshow(count, cmap="Blues", vmin=0, extent=(0.5, run.N + 0.5, run.N + 0.5, 0.5))
    left.set_xlim(0.5, run.N + 0.5)
    left.set_ylim(run.N + 0.5, 0.5)
    left.set_aspect("equal")
    left.set_xlabel("heard agent, by distance from the leader")
    left.set_ylabel("hearing agent")
    left.set_title("Who hears whom")

    error = run.final_error
    across = distance if profile is None else profile
    known = np.isfinite(error) & (error > 0) & np.isfinite(across)
    pinned = network.pinning > 0
    for chosen, colour, marker, text in (
        (known & ~pinned, GREY, "o", "agent"),
        (known & pinned, BLUE, "D", "pinned agent"),
    ):
        shown = np.clip(error[chosen], 1e-300, 1e60)
        right.plot(across[chosen], shown, ls="none", marker=marker, ms=3.6, mew=0, alpha=0.75,
                   color=colour, label=text)  # fmt: skip
    lost = ~np.isfinite(error) & np.isfinite(across)
    if known.any():
        right.set_yscale("log")
        from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

        right.yaxis.set_major_locator(LogLocator(numticks=7))
        right.yaxis.set_major_formatter(FuncFormatter(power_of_ten))
        right.yaxis.set_minor_locator(NullLocator())
    if lost.any():
        top = np.full(lost.sum(), 0.97)
        right.plot(across[lost], top, ls="none", marker="X", ms=5, mew=0, color=VERMILION,
                   transform=right.get_xaxis_transform(), label="lost")  # fmt: skip
    right.set_xlabel("arcs from the leader" if profile is None else "p: how far the leader is")
    right.set_ylabel(f"final error{_of_what(run)}")
    right.set_title("Final error against distance")
    right.legend(loc="best")
    return figure
