"""A cooling run, or several controllers on the same plant, as frozen objects for the KPI page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.report.foreign import AGAIN, clean, number
from posmas_fmi.report.json_files import read_json
from posmas_fmi.report.kpi_signals import Signals, read_signals

BAND = 1.0  # K, where the run does not state its own
SAME = 0.05  # relative: figures this close to each other count as equal


@attrs.frozen
class Kpi:
    """A key figure: what it is called and which direction is good."""

    key: str
    label: str
    unit: str
    better: str | None  # "low", "high"


@attrs.frozen
class Limit:
    """A limit that a key figure must keep."""

    name: str
    kpi: str
    limit: float
    unit: str
    above: bool
    text: str

    def holds(self, value: float | None) -> bool | None:
        """Whether a value keeps it; None where the value is not known."""
        if value is None:
            return None
        return value >= self.limit if self.above else value <= self.limit


@attrs.frozen(eq=False)
class Controller:
    """One controller: its figures, its limits, its signals."""

    name: str
    figures: Mapping[str, Any]
    kept: Mapping[str, bool | None]
    signals: Signals | None
    certified: str
    verdict: str
    report: str  # relative link to its own report, or ""

    def value(self, key: str) -> float | None:
        """Return one of its key figures; None where it is not known."""
        return number(self.figures.get(key))

    @property
    def broken(self) -> int:
        """Number of limits that it does not keep."""
        return sum(kept is False for kept in self.kept.values())


@attrs.frozen(eq=False)
class KpiRun:
    """What the KPI page shows."""

    scenario: str
    created_by: str
    controllers: tuple[Controller, ...]
    kpis: tuple[Kpi, ...]
    limits: tuple[Limit, ...]
    practice: str | None
    band: float
    faults: tuple[Mapping[str, Any], ...]
    incidents: tuple[Mapping[str, Any], ...]
    manifest: Mapping[str, Any]

    def controller(self, name: str | None) -> Controller | None:
        """Return a controller by its name."""
        return next((c for c in self.controllers if c.name == name), None)

    @property
    def best(self) -> Controller:
        """The controller to take: fewest limits broken, then least worst deviation.

        Practice stays if nothing else breaks fewer limits and is clearly better in deviation.
        """

        def rank(c: Controller) -> tuple[int, float, float]:
            worst, rms = c.value("worst_K"), c.value("rms_K")
            infinite = math.inf
            return c.broken, infinite if worst is None else worst, infinite if rms is None else rms

        first = min(self.controllers, key=rank)
        practice = self.controller(self.practice)
        if practice is not None and practice.broken <= first.broken:
            ours, theirs = first.value("worst_K"), practice.value("worst_K")
            if ours is not None and theirs is not None and theirs <= (1 + SAME) * ours:
                return practice
        return first

    def better(self, kpi: Kpi) -> frozenset[str]:
        """Names of the controllers with the best value of a key figure; empty if all are alike."""
        values = {c.name: v for c in self.controllers if (v := c.value(kpi.key)) is not None}
        if kpi.better is None or len(values) < 2:
            return frozenset()
        best = min(values.values()) if kpi.better == "low" else max(values.values())
        close = frozenset(n for n, v in values.items() if alike(v, best))
        return frozenset() if len(close) == len(values) else close


def alike(a: float, b: float) -> bool:
    """Whether two figures are too close to call one of them better.

    Examples
    --------
    >>> alike(1.0, 1.04), alike(1.0, 1.5)
    (True, False)
    """
    return a == b or abs(a - b) <= SAME * max(abs(a), abs(b))


def has_kpis(folder: Path) -> bool:
    """Whether a folder holds key figures of cooling, of one controller or of several."""
    path = folder / "summary.json"
    if not path.is_file():
        return False
    content = read_json(path)
    return bool(content.get("kpi")) and bool(content.get("comparison"))


def read_kpis(folder: Path) -> KpiRun:
    """Read the folder of a comparison, or of a single cooling run.

    Raises
    ------
    InputError
        If a file is missing or cannot be used.
    """
    path = folder / "summary.json"
    content = read_json(path)
    comparison = _objects(content, "comparison", path)
    kpis = tuple(
        Kpi(key, str(k.get("label", key)), str(k.get("unit", "")), _direction(k.get("better")))
        for key, k in _objects(content, "kpi", path).items()
    )
    limits = tuple(_limits(content, path))
    single = (folder / "results.nc").is_file()
    controllers = []
    for name, figures in comparison.items():
        place = folder if single else folder / name
        inside = place.resolve().parent == folder.resolve() or single
        results = place / "results.nc"
        signals = read_signals(results, content) if inside and results.is_file() else None
        design, summary = _optional(place, "design.json"), _optional(place, "summary.json")
        stated = figures.get("limits")
        given = stated if isinstance(stated, dict) else {}
        controllers.append(
            Controller(
                name=name,
                figures=figures,
                kept={
                    item.name: given[item.name]
                    if isinstance(given.get(item.name), bool)
                    else item.holds(number(figures.get(item.kpi)))
                    for item in limits
                },
                signals=signals,
                certified=str(design.get("certified", "")),
                verdict=str(figures.get("verdict") or summary.get("verdict") or ""),
                report=_link(name, single) if inside and (single or place.is_dir()) else "",
            )
        )
    practice = content.get("practice")
    manifest = _optional(folder, "manifest.json")
    return KpiRun(
        scenario=clean(str(content.get("scenario") or manifest.get("name") or folder.name)),
        created_by=clean(str(content.get("created_by", ""))),
        controllers=tuple(controllers),
        kpis=kpis,
        limits=limits,
        practice=practice if isinstance(practice, str) and practice in comparison else None,
        band=number(content.get("band_K")) or BAND,
        faults=_rows(content, "faults"),
        incidents=_rows(content, "incidents"),
        manifest=manifest,
    )


def _link(name: str, single: bool) -> str:
    from urllib.parse import quote

    return "report.html" if single else f"{quote(name)}/report.html"


def _optional(folder: Path, name: str) -> dict[str, Any]:
    path = folder / name
    return read_json(path) if path.is_file() else {}


def _objects(content: Mapping[str, Any], key: str, path: Path) -> dict[str, dict[str, Any]]:
    value = content.get(key)
    if not isinstance(value, dict) or not all(isinstance(v, dict) for v in value.values()):
        raise InputError(f"$.{key}: expected an object of objects; {AGAIN}", str(path))
    return value


def _rows(content: Mapping[str, Any], key: str) -> tuple[Mapping[str, Any], ...]:
    value = content.get(key)
    return tuple(v for v in value if isinstance(v, dict)) if isinstance(value, list) else ()


def _direction(value: Any) -> str | None:
    return value if value in ("low", "high") else None


def _limits(content: Mapping[str, Any], path: Path) -> list[Limit]:
    found = []
    for row in _rows(content, "limits"):
        bound = number(row.get("limit"))
        if bound is None:
            raise InputError(f"$.limits: expected a number as 'limit'; {AGAIN}", str(path))
        found.append(
            Limit(
                name=str(row.get("name", "")),
                kpi=str(row.get("kpi", "")),
                limit=bound,
                unit=str(row.get("unit", "")),
                above=row.get("above") is True,
                text=str(row.get("text", "")),
            )
        )
    return found


def largest(values: Array) -> float:
    """Return the largest finite modulus; 0 without any."""
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max(initial=0.0))
