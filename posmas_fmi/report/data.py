"""The stored results of a run as one frozen object, with the errors derived from them."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import scipy.sparse as sp

from posmas_fmi.agent import Assumption
from posmas_fmi.errors import InputError, NetworkError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

# Entries read of one variable. Longer runs are read with a stride: a plot cannot show more, and
# the figures of merit are in summary.json, computed by the master from every sample.
LARGEST_VARIABLE = 8_000_000

# An agent counts as lost once its tracking error stays over this multiple of what the run
# started with.
LOST_FACTOR = 100.0

AGAIN = "run the scenario again with 'posmas-fmi run'"


@attrs.frozen
class Condition:
    """One condition of the certificate."""

    name: str
    holds: bool
    margin: float | None
    proof: str
    detail: str


@attrs.frozen(eq=False)
class DesignFacts:
    """What ``design.json`` says; attributes are the keys of ``posmas-fmi design --json``."""

    method: str
    observer: str
    protocol: str
    phi: float | None
    mu: float | None
    K: Array
    E: Array
    certified: str
    assumptions: tuple[Assumption, ...]
    rate: float | None
    observer_rate: float | None
    positive: bool
    p_max: float | None
    period: float | None
    conditions: tuple[Condition, ...]
    covers: tuple[str, ...]
    notes: tuple[str, ...]
    region: str
    baseline_rate: float | None
    sector: tuple[float, float] | None


@attrs.frozen
class AgentVerdict:
    """What ``summary.json`` says about one agent."""

    name: str
    status: str
    final_error: float | None


@attrs.frozen
class Summary:
    """What ``summary.json`` says about the run; derived from the results if the run was cut off."""

    verdict: str
    agents: tuple[AgentVerdict, ...]
    tracking_error: float | None
    estimation_error: float | None
    min_state: float | None
    wall_s: float | None
    steps: int | None
    comparison: Mapping[str, Any]
    messages: tuple[str, ...]


@attrs.frozen(eq=False)
class Run:
    """Everything the report shows.

    Attributes
    ----------
    time : (T,) array
        [s]
    labels : mapping
        ``"state"``, ``"input"``, ``"output"`` -> names of the components.
    x, xhat, x_baseline : (T, N, m) array
        States, estimates, states of the same run with K = 0. x and x_baseline may be None.
    s : (T, m) array
        Leader.
    u, sec_u : (T, N, p) array
        Input and what the sector nonlinearity makes of it. sec_u may be None.
    y : (T, N, q) array
        Outputs.
    stride : int
        Every how many stored samples one was read.
    """

    scenario: str
    created_by: str
    complete: bool
    period: float | None
    stride: int
    units: Mapping[str, str]
    names: tuple[str, ...]
    labels: Mapping[str, tuple[str, ...]]
    network: Network
    time: Array
    x: Array | None
    xhat: Array
    x_baseline: Array | None
    s: Array
    u: Array
    sec_u: Array | None
    y: Array
    design: DesignFacts
    summary: Summary
    manifest: Mapping[str, Any]

    @property
    def N(self) -> int:
        """Number of agents."""
        return self.xhat.shape[1]

    @property
    def m(self) -> int:
        """Number of states of an agent."""
        return self.xhat.shape[2]

    @property
    def p(self) -> int:
        """Number of inputs of an agent."""
        return self.u.shape[2]

    @property
    def until(self) -> float:
        """Time of the last sample [s]; NaN without samples."""
        return float(self.time[-1]) if self.time.size else math.nan

    @cached_property
    def shown(self) -> Array:
        """The states where the plant shows them, the estimates elsewhere, (T, N, m)."""
        if self.x is None:
            return self.xhat
        hidden = np.isnan(self.x).all(axis=(0, 2))
        return np.where(hidden[None, :, None], self.xhat, self.x)

    @cached_property
    def estimation_error(self) -> Array | None:
        """``e = x - xhat``, (T, N, m)."""
        with np.errstate(all="ignore"):
            return None if self.x is None else self.x - self.xhat

    @cached_property
    def tracking_error(self) -> Array:
        """``x - s``, or ``xhat - s`` for a plant that does not show x, (T, N, m)."""
        with np.errstate(all="ignore"):
            return self.shown - self.s[:, None, :]

    @cached_property
    def baseline_error(self) -> Array | None:
        """``x - s`` of the run with K = 0, (T, N, m)."""
        with np.errstate(all="ignore"):
            return None if self.x_baseline is None else self.x_baseline - self.s[:, None, :]

    @cached_property
    def final_error(self) -> Array:
        """Largest entry of the tracking error of each agent at the last sample, (N,)."""
        if not self.time.size:
            return np.full(self.N, np.nan)
        return np.asarray(np.abs(self.tracking_error[-1]).max(axis=-1))

    @cached_property
    def worst(self) -> int:
        """Index of the agent with the largest final error; one that is not finite comes first."""
        return int(np.argmax(np.where(np.isfinite(self.final_error), self.final_error, np.inf)))

    @cached_property
    def lost_at(self) -> Array:
        """When each agent was lost for good [s], (N,): infinite for an agent that was not.

        Lost: not finite, or a tracking error over `LOST_FACTOR` times the larger of the leader
        and the first error, up to the last sample.
        """
        lost = np.full(self.N, np.inf)
        if not self.time.size:
            return lost
        error = np.abs(self.tracking_error).max(axis=-1)
        leader = np.abs(self.s[np.isfinite(self.s).all(axis=1)])
        scale = np.nanmax([leader.max(initial=0.0), np.nan_to_num(error[0]).max(), 1e-300])
        within = error <= LOST_FACTOR * scale  # False for NaN
        for i in np.flatnonzero(~within[-1]):
            ends = np.flatnonzero(within[:, i])
            lost[i] = self.time[ends[-1] + 1] if ends.size else self.time[0]
        return lost

    @property
    def first_lost(self) -> tuple[int, float] | None:
        """Agent (index) and time [s] of the first loss."""
        i = int(np.argmin(self.lost_at))
        return (i, float(self.lost_at[i])) if np.isfinite(self.lost_at[i]) else None

    @cached_property
    def p_profile(self) -> Array | None:
        """``p`` with ``L_p p = 1``, (N,), or None if the leader does not reach every agent."""
        try:
            return self.network.p
        except NetworkError:
            return None


def read_run(folder: Path) -> Run:
    """Read the folder of a run.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    Run

    Raises
    ------
    InputError
        If a file is missing or cannot be used.
    """
    if not folder.is_dir():
        came = "a file" if folder.exists() else "there is none"
        raise InputError(
            f"expected the folder of a run ({came}); make one with 'posmas-fmi run'", str(folder)
        )
    manifest = _read_json(folder / "manifest.json")
    design = _design(_read_json(folder / "design.json"), manifest, folder / "design.json")
    signals = _read_results(folder / "results.nc")
    draft = Run(design=design, summary=_NO_SUMMARY, manifest=manifest, **signals)
    path = folder / "summary.json"
    if not draft.complete and not path.exists():
        return attrs.evolve(draft, summary=_derived_summary(draft))
    return attrs.evolve(draft, summary=_summary(_read_json(path), path))


# ---------------------------------------------------------------------------------------------
# results.nc


def _read_results(path: Path) -> dict[str, Any]:
    import xarray

    if not path.is_file():
        raise InputError(f"the file is missing; {AGAIN}", str(path))
    try:
        dataset = xarray.open_dataset(
            path, engine="h5netcdf", decode_times=False, decode_coords=False
        )
    except Exception as error:  # whatever the HDF5 stack raises on a broken file
        raise InputError(
            f"expected a NetCDF-4 file (reading it failed: {_one_line(error)}); {AGAIN}", str(path)
        ) from error
    with dataset:
        try:
            return _signals(dataset, path)
        except InputError:
            raise
        except Exception as error:  # a truncated file may open and then fail while being read
            raise InputError(
                f"the file is damaged (reading it failed: {_one_line(error)}); {AGAIN}", str(path)
            ) from error


def _signals(dataset: Any, path: Path) -> dict[str, Any]:
    for name in ("time", "xhat", "u", "y", "s", "pinning", "arc_from", "arc_to"):
        if name not in dataset.variables:
            found = ", ".join(sorted(map(str, dataset.variables)))
            raise InputError(
                f"expected a variable '{clean(name)}' (found {clean(found)}); {AGAIN}", str(path)
            )
    largest = max(
        (dataset[name].size for name in ("x", "xhat", "u", "y") if name in dataset), default=0
    )
    stride = max(1, math.ceil(largest / LARGEST_VARIABLE))
    time = _numbers(dataset, "time", ("time",), path)
    rows = _recorded(time)
    # the last sample decides on the verdict, so it is read whatever the stride
    last = np.array([rows - 1] if rows and (rows - 1) % stride else [], dtype=int)
    index = np.concatenate([np.arange(0, rows, stride), last])

    def read(name: str, dim: str) -> Array | None:
        if name not in dataset.variables:
            return None
        dims = ("time", "agent", dim) if name != "s" else ("time", dim)
        return _numbers(dataset, name, dims, path, index)

    xhat, u, y, s = read("xhat", "state"), read("u", "input"), read("y", "output"), read("s", "state")
    assert xhat is not None and u is not None and y is not None and s is not None
    optional = {name: _unless_nan(read(name, dim)) for name, dim in _OPTIONAL}
    # rows that were allocated but never written
    written = [np.isfinite(a).reshape(len(index), -1).any(axis=1) for a in (xhat, u, s)]
    filled = np.flatnonzero(np.any(written, axis=0))
    keep = slice(0, int(filled[-1]) + 1 if filled.size else 0)
    names = _labels(dataset, "agent", xhat.shape[1])
    attributes = dataset.attrs
    return {
        "scenario": clean(str(attributes.get("scenario", "run"))),
        "created_by": clean(str(attributes.get("created_by", ""))),
        "complete": bool(np.all(attributes.get("complete", 1))),
        "period": number(attributes.get("period")),
        "stride": stride,
        "units": {
            str(name): clean(str(dataset[name].attrs["units"]))
            for name in dataset.variables
            if "units" in dataset[name].attrs
        },
        "names": names,
        "labels": {
            dim: _labels(dataset, dim, size)
            for dim, size in (("state", xhat.shape[2]), ("input", u.shape[2]), ("output", y.shape[2]))
        },
        "network": _network(dataset, names, path),
        "time": time[index][keep],
        "xhat": xhat[keep],
        "u": u[keep],
        "y": y[keep],
        "s": s[keep],
        **{name: None if value is None else value[keep] for name, value in optional.items()},
    }


_OPTIONAL = (("x", "state"), ("x_baseline", "state"), ("sec_u", "input"))


def _numbers(
    dataset: Any, name: str, dims: tuple[str, ...], path: Path, index: Array | None = None
) -> Array:
    variable = dataset[name]
    if set(variable.dims) != set(dims) or variable.dtype.kind not in "fiub":
        raise InputError(
            f"expected numbers over ({', '.join(dims)}) in '{name}' "
            f"(got {variable.dtype} over ({clean(', '.join(map(str, variable.dims)))})); {AGAIN}",
            str(path),
        )
    variable = variable.transpose(*dims)
    if index is not None and len(index) < dataset.sizes["time"]:
        stop = int(index[-1]) + 1 if len(index) else 0
        step = int(index[1] - index[0]) if len(index) > 1 else 1
        values = np.asarray(variable[:stop:step], dtype=float)
        if len(values) < len(index):
            values = np.concatenate([values, np.asarray(variable[stop - 1 : stop], dtype=float)])
        return values
    return np.asarray(variable, dtype=float)


def _recorded(time: Array) -> int:
    """Return the number of leading rows whose times are finite and increase."""
    if not time.size or not np.isfinite(time[0]):
        return 0
    ends = np.flatnonzero(~(np.diff(time) > 0))
    return int(ends[0]) + 1 if ends.size else len(time)


def _unless_nan(values: Array | None) -> Array | None:
    return None if values is None or np.isnan(values).all() else values


def _labels(dataset: Any, dim: str, count: int) -> tuple[str, ...]:
    if dim not in dataset.variables:
        return tuple(str(k + 1) for k in range(count))
    return tuple(
        clean(label.decode("utf-8", "replace") if isinstance(label, bytes) else str(label))
        for label in dataset[dim].values.tolist()
    )


def _network(dataset: Any, names: tuple[str, ...], path: Path) -> Network:
    n = len(names)
    pinning = _numbers(dataset, "pinning", ("agent",), path)
    source, target = (_numbers(dataset, key, ("arc",), path) for key in ("arc_from", "arc_to"))
    weight = (
        _numbers(dataset, "arc_weight", ("arc",), path)
        if "arc_weight" in dataset.variables
        else np.ones(len(source))
    )
    ends = np.concatenate([source, target])
    if not ((ends >= 0) & (ends < n) & (ends == np.floor(ends))).all():
        raise InputError(
            f"expected agents from 0 to {n - 1} in 'arc_from' and 'arc_to'; {AGAIN}", str(path)
        )
    adjacency = sp.csr_array((weight, (target.astype(int), source.astype(int))), shape=(n, n))
    try:
        return Network(adjacency, pinning, names)
    except NetworkError as error:
        raise InputError(f"the stored network is not usable ({error}); {AGAIN}", str(path)) from error


# ---------------------------------------------------------------------------------------------
# JSON files


def clean(text: str) -> str:
    """Replace characters that cannot be printed (controls, surrogates, direction overrides)."""
    return "".join(c if c.isprintable() or c in "\n\t" else "�" for c in text)


def number(value: Any) -> float | None:
    """Return a finite or infinite number as float, None for anything else and for NaN."""
    if isinstance(value, str | bytes | bool) or value is None:
        return None
    try:
        result = float(np.asarray(value).item())
    except (TypeError, ValueError, OverflowError):
        return None
    return None if math.isnan(result) else result


def _one_line(error: Exception) -> str:
    lines = clean(str(error)).splitlines()
    return lines[0][:200] if lines else type(error).__name__


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"the file is missing; {AGAIN}", str(path)) from None
    except OSError as error:
        raise InputError(f"cannot read the file ({error.strerror}); {AGAIN}", str(path)) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected JSON ({_one_line(error)}); {AGAIN}", str(path)) from error
    if not isinstance(content, dict):
        raise InputError(f"expected a JSON object (got {type(content).__name__}); {AGAIN}", str(path))
    return {str(key): value for key, value in _cleaned(content).items()}


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


def _design(content: dict[str, Any], manifest: Mapping[str, Any], path: Path) -> DesignFacts:
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
    return "" if radius is None else f"|δ| ≤ {radius:.3g} in every entry. {region.text('detail', '')}"


def _assumption(keys: _Keys) -> Assumption:
    status = keys.text("status")
    if status == "verified" or status == "declared" or status == "contradicted":
        return Assumption(keys.text("name"), status, keys.text("detail", ""))
    raise keys.fail("status", '"verified", "declared" or "contradicted"')


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


_NO_SUMMARY = Summary("", (), None, None, None, None, None, {}, ())


def _summary(content: dict[str, Any], path: Path) -> Summary:
    keys = _Keys(content, path)
    steps = keys.number("steps")
    return Summary(
        verdict=keys.text("verdict"),
        agents=tuple(
            AgentVerdict(
                str(entry.content.get("name", "")),
                entry.text("status", ""),
                entry.number("final_error"),
            )
            for entry in keys.objects("agents")
        ),
        tracking_error=keys.number("tracking_error_final"),
        estimation_error=keys.number("estimation_error_final"),
        min_state=keys.number("min_state"),
        wall_s=keys.number("wall_s"),
        steps=None if steps is None or math.isinf(steps) else int(steps),
        comparison=keys.mapping("comparison"),
        messages=keys.texts("messages"),
    )


def _derived_summary(run: Run) -> Summary:
    error, estimation = run.final_error, run.estimation_error
    lost = np.isfinite(run.lost_at)
    return Summary(
        verdict="diverged" if lost.any() else "cut off",
        agents=tuple(
            AgentVerdict(name, "lost" if lost[i] else "cut off", number(error[i]))
            for i, name in enumerate(run.names)
        ),
        tracking_error=number(error.max()),
        estimation_error=(
            None if estimation is None or not len(run.time) else number(np.abs(estimation[-1]).max())
        ),
        min_state=number(np.nanmin(run.x)) if run.x is not None and run.x.size else None,
        wall_s=None,
        steps=max(len(run.time) - 1, 0) * run.stride,
        comparison={},
        messages=(),
    )
