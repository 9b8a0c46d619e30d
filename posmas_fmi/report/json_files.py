"""``design.json``, ``summary.json`` and ``manifest.json``: checked key by key."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast, get_args

import attrs
import numpy as np

from posmas_fmi.agent import Assumption, Status
from posmas_fmi.bounded import require_regular
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.report.data import (
    AgentVerdict,
    Condition,
    DesignFacts,
    Fault,
    Incident,
    Summary,
    Used,
)
from posmas_fmi.report.foreign import AGAIN, clean, number, one_line


def read_json(path: Path) -> dict[str, Any]:
    """Read a file that holds one JSON object; InputError if it does not."""
    try:
        require_regular(path)
        content = _cleaned(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise InputError(f"the file is missing; {AGAIN}", str(path)) from None
    except OSError as error:
        raise InputError(f"cannot read the file ({error.strerror}); {AGAIN}", str(path)) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected JSON ({one_line(error)}); {AGAIN}", str(path)) from error
    if not isinstance(content, dict):
        raise InputError(
            f"expected a JSON object (got {type(content).__name__}); {AGAIN}", str(path)
        )
    return {str(key): value for key, value in content.items()}


def _cleaned(value: Any) -> Any:
    if isinstance(value, str):
        return clean(value)
    if isinstance(value, list):
        return [_cleaned(entry) for entry in value]
    if isinstance(value, dict):
        return {clean(str(key)): _cleaned(entry) for key, entry in value.items()}
    return value


@attrs.frozen
class _Keys:
    """Typed access to a JSON object; a wrong type is an InputError that names file and key."""

    content: Mapping[str, Any]
    path: Path
    place: str = "$"

    def fail(self, key: str, expected: str) -> InputError:
        came = self.content.get(key, "nothing")
        return InputError(
            f"{self.place}.{key}: expected {expected} (got {str(came)[:60]!r}); {AGAIN}",
            str(self.path),
        )

    def text(self, key: str, default: str | None = None) -> str:
        value = self.content.get(key, default)
        if not isinstance(value, str):
            raise self.fail(key, "text")
        return value

    def number(self, key: str) -> float | None:
        value = self.content.get(key)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise self.fail(key, "a number")
        return number(value)

    def flag(self, key: str) -> bool:
        value = self.content.get(key)
        if not isinstance(value, bool):
            raise self.fail(key, "true or false")
        return value

    def matrix(self, key: str) -> Array:
        try:
            value = np.array(self.content.get(key), dtype=float)
        except (TypeError, ValueError):
            value = np.empty(0)
        if value.ndim != 2:
            raise self.fail(key, "a matrix as a list of rows")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        value = self.content.get(key) or []
        if isinstance(value, str):
            return (value,)
        if not isinstance(value, list):
            raise self.fail(key, "a list of texts")
        return tuple(str(entry) for entry in value)

    def objects(self, key: str, required: bool = True) -> tuple[_Keys, ...]:
        value = self.content.get(key, None if required else [])
        if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
            raise self.fail(key, "a list of objects")
        return tuple(
            _Keys(entry, self.path, f"{self.place}.{key}[{k}]") for k, entry in enumerate(value)
        )

    def mapping(self, key: str) -> Mapping[str, Any]:
        value = self.content.get(key) or {}
        if not isinstance(value, dict):
            raise self.fail(key, "an object")
        return value


def design_facts(content: dict[str, Any], manifest: Mapping[str, Any], path: Path) -> DesignFacts:
    """Return what ``design.json`` says; InputError names the key that is not as agreed."""
    keys = _Keys(content, path)
    certified = keys.text("certified")
    if certified not in ("yes", "conditional", "no"):
        raise keys.fail("certified", '"yes", "conditional" or "no"')
    return DesignFacts(
        method=keys.text("method"),
        observer=keys.text("observer", ""),
        protocol=keys.text("protocol", ""),
        phi=keys.number("phi"),
        mu=keys.number("mu"),
        K=keys.matrix("K"),
        E=keys.matrix("E"),
        certified=certified,
        assumptions=tuple(_assumption(entry) for entry in keys.objects("assumptions")),
        rate=keys.number("rate"),
        observer_rate=keys.number("observer_rate"),
        rate_perron=keys.number("rate_perron"),
        positive=keys.flag("positive"),
        p_max=keys.number("p_max"),
        period=keys.number("period"),
        conditions=tuple(
            Condition(
                entry.text("name"),
                entry.flag("holds"),
                entry.number("margin"),
                entry.text("proof", ""),
                entry.text("detail", ""),
            )
            for entry in keys.objects("conditions")
        ),
        covers=keys.texts("covers"),
        notes=keys.texts("notes"),
        region=_region(keys),
        baseline_rate=_Keys(keys.mapping("baseline"), path, "$.baseline").number("rate"),
        sector=_sector(content.get("sector")) or _sector_of_scenario(manifest),
    )


def _region(keys: _Keys) -> str:
    region = _Keys(keys.mapping("region_of_attraction"), keys.path, "$.region_of_attraction")
    radius = region.number("radius")
    return (
        "" if radius is None else f"|δ| ≤ {radius:.3g} in every entry. {region.text('detail', '')}"
    )


def _assumption(keys: _Keys) -> Assumption:
    status = keys.text("status")
    if status not in get_args(Status):
        raise keys.fail("status", " or ".join(get_args(Status)))
    return Assumption(keys.text("name"), cast(Status, status), keys.text("detail", ""))


def _sector(value: Any) -> tuple[float, float] | None:
    if not isinstance(value, list) or len(value) != 2:
        return None
    low, high = number(value[0]), number(value[1])
    return None if low is None or high is None else (low, high)


def _sector_of_scenario(manifest: Mapping[str, Any]) -> tuple[float, float] | None:
    for text in manifest.values():
        if isinstance(text, str) and "\n" in text:
            try:
                agent = tomllib.loads(text).get("agent")
            except tomllib.TOMLDecodeError:
                continue
            if isinstance(agent, dict) and (sector := _sector(agent.get("sector"))):
                return sector
    return None


def _traffic(keys: _Keys) -> tuple[str, ...]:
    sent, lost = keys.number("messages_sent"), keys.number("messages_lost")
    if not sent:
        return ()
    share = f", {100 * lost / sent:.3g} % of them lost" if lost else ", none lost"
    return (f"{sent:.0f} messages between agents{share}",)


def _replay(keys: _Keys) -> tuple[str, ...]:
    noise = keys.number("replay_noise")
    if noise is None:
        return ()
    if noise == 0:
        return ("a step that was done again came to the same, bit for bit",)
    return (
        f"a step that was done again differed by {noise:.3g}, relative: replay noise, twice which "
        "is in the tolerance of the coupling",
    )


def summary_facts(content: dict[str, Any], path: Path) -> Summary:
    """Return what ``summary.json`` says; InputError names the key that is not as agreed."""
    keys = _Keys(content, path)
    steps = keys.number("steps")
    return Summary(
        verdict=keys.text("verdict"),
        reason=keys.text("reason", ""),
        agents=tuple(
            AgentVerdict(
                str(entry.content.get("name", "")),
                entry.text("status", ""),
                entry.number("final_error"),
                entry.number("min_state"),
            )
            for entry in keys.objects("agents")
        ),
        tracking_error=keys.number("tracking_error_final"),
        estimation_error=keys.number("estimation_error_final"),
        min_state=keys.number("min_state"),
        wall_s=keys.number("wall_s"),
        steps=None if steps is None or math.isinf(steps) else int(steps),
        comparison=keys.mapping("comparison"),
        notes=(*keys.texts("messages"), *_traffic(keys), *_replay(keys)),
        band=keys.number("band_K") if "band_K" in content else None,
        coverage=tuple(
            Used(row.text("what"), row.flag("covered"), row.text("why", ""))
            for row in keys.objects("coverage", required=False)
        )
        if "coverage" in content
        else None,
        faults=tuple(_fault(row) for row in keys.objects("faults", required=False)),
        incidents=tuple(
            Incident(
                row.text("agent", ""),
                row.number("time"),
                row.text("call", ""),
                row.text("verdict", ""),
                row.text("action", ""),
                row.text("fmu", ""),
                inputs_text(row.mapping("inputs")),
                clean("\n".join((*row.texts("messages"), row.text("output", "")))).strip(),
                row.text("detail", ""),
            )
            for row in keys.objects("incidents", required=False)
        ),
    )


def inputs_text(inputs: Mapping[str, Any]) -> str:
    """Return the inputs of a step as text: ``u = 0.06, v = 1``.

    Examples
    --------
    >>> inputs_text({"u": 0.0625, "v": None})
    'u = 0.0625, v = not finite'
    """
    found = {name: number(value) for name, value in inputs.items()}
    return ", ".join(
        f"{clean(name)} = {'not finite' if value is None else f'{value:.6g}'}"
        for name, value in found.items()
    )


def _fault(row: _Keys) -> Fault:
    covered = row.content.get("covered", "")
    if isinstance(covered, bool):
        covered = "covered" if covered else "not covered"
    return Fault(
        kind=row.text("kind"),
        agent=row.text("agent", ""),
        begin=row.number("from"),
        end=row.number("until"),
        detail=row.text("detail", ""),
        covered=str(covered),
        proved=str(covered).startswith("covered"),
    )
