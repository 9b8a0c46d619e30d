"""The network at one time, coloured by deviation: an SVG that the page's slider recolours."""

from __future__ import annotations

import base64
import math
from html import escape
from typing import Any

import numpy as np

from posmas_fmi.expression import Array
from posmas_fmi.network import Network
from posmas_fmi.report.kpi_data import Controller, KpiRun, largest
from posmas_fmi.report.network_drawing import MOST_NODES, layout

COLOURS = "PuOr_r"  # purple is cool, orange is warm; even to readers with any colour vision
MOST_VALUES = 100_000  # of one controller: times × lines
MOST_FRAMES = 240
LEVELS = 65534  # 65535 stands for a value that is not known
UNKNOWN = "#d1d5db"
WIDTH, HEIGHT = 640.0, 360.0


def frames(run: KpiRun) -> tuple[Array, int]:
    """Return the shown times [s], and the index of the worst moment among them."""
    first = _first(run)
    assert first is not None
    assert first.signals is not None
    time, n = first.signals.time, first.signals.N
    count = int(np.clip(MOST_VALUES // n, 24, MOST_FRAMES))
    chosen = np.unique(np.linspace(0, len(time) - 1, min(count, len(time))).astype(int))
    shown = run.best if run.best.signals is not None else first
    assert shown.signals is not None
    deviation = np.abs(np.nan_to_num(shown.signals.deviation, posinf=0, neginf=0)).max(axis=1)
    worst = int(deviation.argmax())
    moment = int(np.abs(time[chosen] - shown.signals.time[worst]).argmin())
    if len(time) == len(deviation):
        chosen[moment] = worst  # the worst moment itself, not one beside it
        chosen.sort()
    return time[chosen], moment


def _first(run: KpiRun) -> Controller | None:
    return next((c for c in run.controllers if c.signals is not None and c.signals.time.size), None)


def palette(steps: int = 65) -> list[str]:
    """Return colours from the coolest to the warmest, as hex.

    Examples
    --------
    >>> colours = palette()
    >>> len(colours), colours[32]
    (65, '#f6f6f7')
    """
    import matplotlib

    colours = matplotlib.colormaps[COLOURS](np.linspace(0.06, 0.94, steps))
    return ["#" + "".join(f"{round(255 * part):02x}" for part in c[:3]) for c in colours.tolist()]


def view_data(run: KpiRun, times: Array) -> dict[str, Any]:
    """Return what the script needs: times, scale, and the deviations, coded."""
    seen = [largest(c.signals.deviation) for c in run.controllers if c.signals is not None]
    limit = float(np.clip(max(seen), 8 * run.band, 500 * run.band))
    coded = {}
    for controller in run.controllers:
        signals = controller.signals
        if signals is None or not signals.time.size:
            continue
        index = np.abs(np.searchsorted(signals.time, times)).clip(max=len(signals.time) - 1)
        rows = signals.deviation[index]
        coded[controller.name] = base64.b64encode(_coded(rows, limit).tobytes()).decode()
    first = _first(run)
    assert first is not None
    assert first.signals is not None
    return {
        "times": [round(float(t), 3) for t in times],
        "lines": list(first.signals.names),
        "span": 2.0 * run.band,  # where the colours end
        "limit": limit,  # where the coded values end
        "band": run.band,
        "palette": palette(),
        "unknown": UNKNOWN,
        "controllers": coded,
    }


def _coded(values: Array, limit: float) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """Deviations from -limit to limit as 0 to `LEVELS`, one more where a value is not finite."""
    scaled = np.clip((np.nan_to_num(values) / limit + 1) / 2, 0, 1) * LEVELS
    return np.where(np.isfinite(values), np.round(scaled), LEVELS + 1).astype("<u2")


def drawing(network: Network, names: tuple[str, ...]) -> str:
    """Return the nodes (and arcs, of few) as an ``<svg>``; the script fills the nodes.

    Each node is a group ``g.line`` in the order of the agents, with a shape, a mark for "beyond
    the band" and a title.
    """
    if len(names) > MOST_NODES:
        return _tiles(network, names)
    return _digraph(network, names)


def _tiles(network: Network, names: tuple[str, ...]) -> str:
    n = len(names)
    columns = math.ceil(math.sqrt(n * WIDTH / HEIGHT))
    size = WIDTH / columns
    height = size * math.ceil(n / columns)
    parts = []
    for i, name in enumerate(names):
        x, y = size * (i % columns), size * (i // columns)
        pinned = network.pinning[i] > 0
        parts.append(
            f'<g class="line{" pinned" if pinned else ""}"><title>{escape(name)}</title>'
            f'<rect x="{x + 0.06 * size:.1f}" y="{y + 0.06 * size:.1f}" width="{0.88 * size:.1f}" '
            f'height="{0.88 * size:.1f}"/>'
            f'<path d="{_mark(x + size / 2, y + size / 2, 0.26 * size)}"/></g>'
        )
    return _svg(parts, WIDTH, height)


def _digraph(network: Network, names: tuple[str, ...]) -> str:
    n = len(names)
    xy = layout(network)
    xy = xy * [1.0, -1.0]
    xy -= xy.min(axis=0)
    spread = np.maximum(np.ptp(xy, axis=0), 1e-9)
    margin = 34.0
    scale = min((WIDTH - 2 * margin) / spread[0], (HEIGHT * 1.15 - 2 * margin) / spread[1])
    xy = xy * scale
    width, height = WIDTH, max(float(np.ptp(xy[:, 1])) + 2 * margin, 140.0)
    xy += [(width - np.ptp(xy[:, 0])) / 2, (height - np.ptp(xy[:, 1])) / 2]
    gaps = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))[~np.eye(n + 1, dtype=bool)]
    radius = float(np.clip(0.36 * gaps.min(), 6.0, 22.0))
    adjacency = network.adjacency.tocoo()
    arcs = [(int(j), int(i), False) for i, j in zip(adjacency.row, adjacency.col, strict=True)]
    arcs += [(n, i, True) for i in network.pinned]
    both = {(j, i) for j, i, _ in arcs}
    parts = [
        _arrow(xy[a], xy[b], radius, pin, 0.16 if (b, a) in both else 0.0) for a, b, pin in arcs
    ]
    x, y = xy[n]
    r = 1.1 * radius
    parts.append(
        f'<path class="leader" d="M{x:.1f} {y - r:.1f}L{x + r:.1f} {y:.1f}L{x:.1f} {y + r:.1f}'
        f'L{x - r:.1f} {y:.1f}Z"><title>leader: the set-point</title></path>'
    )
    fits = all(len(name) <= 4 for name in names)
    for i, name in enumerate(names):
        x, y = xy[i]
        pinned = " pinned" if network.pinning[i] > 0 else ""
        label = escape(name) if fits else str(i + 1)
        size = min(0.85, 1.7 / max(len(label), 1)) * radius
        parts.append(
            f'<g class="line{pinned}"><title>{escape(name)}</title>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}"/>'
            f'<path d="{_mark(x, y - 0.62 * radius, 0.3 * radius)}"/>'
            f'<text x="{x:.1f}" y="{y + 0.42 * radius:.1f}" font-size="{size:.1f}">'
            f"{label}</text></g>"
        )
    return _svg(parts, width, height)


def _mark(x: float, y: float, r: float) -> str:
    """Triangle that points up; the page turns it for a line that is too cool."""
    return f"M{x:.1f} {y - r:.1f}L{x + r:.1f} {y + 0.8 * r:.1f}L{x - r:.1f} {y + 0.8 * r:.1f}Z"


def _arrow(a: Array, b: Array, radius: float, pin: bool, bend: float) -> str:
    way = b - a
    length = max(float(np.hypot(*way)), 1e-9)
    along, across = way / length, np.array([-way[1], way[0]]) / length
    start, end = a + along * (radius + 2), b - along * (radius + 4)
    middle = (start + end) / 2 + across * bend * length
    last = end - middle
    last = last / max(float(np.hypot(*last)), 1e-9)
    side = np.array([-last[1], last[0]])
    head = [end, end - 7 * last + 3 * side, end - 7 * last - 3 * side]
    tip = "L".join(f"{p[0]:.1f} {p[1]:.1f}" for p in head)
    kind = "arc pin" if pin else "arc"
    curve = " ".join(f"{v:.1f}" for v in (*middle, *end))
    return (
        f'<g class="{kind}"><path class="shaft" d="M{start[0]:.1f} {start[1]:.1f}Q{curve}"/>'
        f'<path class="head" d="M{tip}Z"/></g>'
    )


def _svg(parts: list[str], width: float, height: float) -> str:
    return (
        f'<svg class="net" viewBox="0 0 {width:.0f} {height:.0f}" role="img">{"".join(parts)}</svg>'
    )
