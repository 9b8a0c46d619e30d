"""From TOML text to tables: strict types, unknown keys refused, every mistake reported at once."""

from __future__ import annotations

import math
import re
import tomllib
import types
import typing
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeGuard

import attrs
import cattrs
from cattrs.errors import (
    AttributeValidationNote,
    ClassValidationError,
    ForbiddenExtraKeysError,
    IterableValidationError,
    IterableValidationNote,
)

from posmas_fmi.bounded import read_bounded
from posmas_fmi.design import DesignSettings
from posmas_fmi.errors import InputError, PosmasError, ScenarioError
from posmas_fmi.scenario.paths import data_files, leaving
from posmas_fmi.scenario.tables import (
    CoolingTable,
    Count,
    NetworkTable,
    Port,
    ScenarioFile,
    ScenarioTable,
    SignalTable,
    Uniform,
)

LARGEST_FILE = 50_000_000  # bytes
DEEPEST = 32  # tables and arrays inside each other
_WORD = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-]){_WORD}(?:[ \t]*+\.[ \t]*+{_WORD}){{{DEEPEST}}}")


def read_tables(
    path: Path, instead: dict[str, Any] | None = None, outside: bool = False
) -> tuple[ScenarioFile, str]:
    """Read a scenario file.

    Parameters
    ----------
    path : Path
    instead : dict, optional
        Values of ``[scenario]`` that take the place of the file's.
    outside : bool
        Whether files outside its folder may be read for ``[cooling]``.

    Returns
    -------
    tables : ScenarioFile
    text : str
        The file as it was.

    Raises
    ------
    InputError
        If there is no such file, or it is not text.
    ScenarioError
        Naming every key that is missing, unknown or of the wrong type.
    """
    text = _read_text(path)
    deep = InputError("the file is nested too deeply to be a scenario", str(path))
    if _LONG_KEY.search(text):  # reading a.a.a.… takes the square of its length
        raise deep
    try:
        document = tomllib.loads(text)
    except ValueError as error:  # also of numbers with thousands of digits
        raise InputError(f"this is not TOML: {error}", str(path)) from None
    except RecursionError:
        raise deep from None
    if _depth_exceeds(document, DEEPEST):
        raise deep
    if not document:
        raise InputError(
            "the file is empty; start from a shipped scenario, see 'posmas-fmi models'", str(path)
        )
    head = document.get("scenario")
    if isinstance(head, dict):
        head |= instead or {}
    converter = _converter()
    problems = _repeated(document)  # what [cooling] stands for may be said again
    if "cooling" in document:
        document = _expand(document, converter, path, outside)
    problems += _design_problems(document.get("design"))
    try:
        tables = converter.structure(document, ScenarioFile)
    except (ClassValidationError, IterableValidationError) as error:
        problems = [*_problems(error, "$"), *problems]
    if problems:
        raise ScenarioError(tuple(problems), str(path))
    return tables, text


def _expand(
    document: dict[str, Any], converter: cattrs.Converter, path: Path, outside: bool
) -> dict[str, Any]:
    """Put the tables that ``[cooling]`` stands for beside those that are written."""
    from posmas_fmi.scenario.cooling import expand

    parts: dict[str, Any] = {}
    problems: list[tuple[str, str]] = []
    for name, kind in (
        ("cooling", CoolingTable),
        ("network", NetworkTable),
        ("scenario", ScenarioTable),
        ("signals", dict[str, SignalTable]),
    ):
        try:
            parts[name] = converter.structure(document.get(name, {}), kind)
        except (ClassValidationError, IterableValidationError) as error:
            problems += _problems(error, f"$.{name}")
    if not problems and not outside:  # the signals are read here
        problems = leaving(path.parent, data_files(parts["network"], parts["signals"]))
    if problems:
        raise ScenarioError(tuple(problems), str(path))
    try:
        more = expand(**parts, folder=path.parent, integral=_integral(document.get("design")))
    except PosmasError as error:
        raise ScenarioError(tuple(error.problems), str(path)) from None
    both, plant = merged(more, document), document.get("plant")
    own = plant.get("override") if isinstance(plant, dict) else None
    if _tables(own):
        both["plant"]["override"] = _beside(more["plant"]["override"], own)
    return both


def _beside(generated: list[dict[str, Any]], own: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Lay what is written for agents over what is generated for them.

    Those that are written come first: errors tell their number in the file.
    """
    rest = {entry["agent"]: entry for entry in generated}
    written = []
    for entry in own:
        agent = entry.get("agent")
        written.append(merged(rest.pop(agent, {}) if isinstance(agent, int) else {}, entry))
    return [*written, *rest.values()]


def _depth_exceeds(value: Any, most: int) -> bool:
    """Whether tables and arrays lie more than so deep inside each other."""
    level = [value]
    for _ in range(most + 1):
        level = [
            entry
            for whole in level
            for entry in (whole.values() if isinstance(whole, dict) else whole)
            if isinstance(entry, dict | list)
        ]
        if not level:
            return False
    return True


def _integral(design: Any) -> bool:
    return isinstance(design, dict) and (design.get("method") == "integral" or "K_q" in design)


def merged(tables: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Lay tables over others: key by key, and lists of tables one after the other.

    Examples
    --------
    >>> merged({"a": {"x": 1, "y": 2}, "b": [{}]}, {"a": {"y": 3}, "b": [{"z": 1}]})
    {'a': {'x': 1, 'y': 3}, 'b': [{}, {'z': 1}]}
    """
    result = dict(tables)
    for key, value in over.items():
        below = result.get(key)
        if isinstance(below, dict) and isinstance(value, dict):
            result[key] = merged(below, value)
        elif isinstance(below, list) and _tables(below) and _tables(value):
            result[key] = [*below, *value]
        else:
            result[key] = value
    return result


def _tables(value: Any) -> TypeGuard[list[dict[str, Any]]]:
    return isinstance(value, list) and all(isinstance(entry, dict) for entry in value)


def _repeated(document: dict[str, Any]) -> list[tuple[str, str]]:
    """Tables of a list that are about the same agent or arc as one before them."""
    problems = []
    for table, name, key in (("plant", "override", "agent"), ("channel", "arc", "arc")):
        first: dict[str, str] = {}
        whole = document.get(table)
        entries = whole.get(name) if isinstance(whole, dict) else None
        for k, entry in enumerate(entries if isinstance(entries, list) else ()):
            if not isinstance(entry, dict) or key not in entry:
                continue
            place, what = f"$.{table}.{name}[{k}]", f"{key} {_show(entry[key])}"
            before = first.setdefault(what, place)
            if before != place:
                problems.append(
                    (f"{place}.{key}", f"{what} is in {before} already; write both as one")
                )
    return problems


def _design_problems(table: Any) -> list[tuple[str, str]]:
    """Unknown keys of ``[design]``, whose table is a class of the design floor."""
    known = [a.name for a in attrs.fields(DesignSettings)]
    keys = table if isinstance(table, dict) else {}
    return [(f"$.design.{key}", _unknown(key, known)) for key in keys if key not in known]


def _read_text(path: Path) -> str:
    if path.is_dir():
        raise InputError("expected a scenario file (got a folder)", str(path))
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(
                f"the file is larger than {LARGEST_FILE // 1_000_000} MB; "
                "keep large networks in a file of their own ($.network.file)",
                str(path),
            )
        return read_bounded(path, LARGEST_FILE).decode("utf-8")
    except FileNotFoundError:
        raise InputError(
            "no such file; 'posmas-fmi models' lists the shipped scenarios", str(path)
        ) from None
    except UnicodeDecodeError:
        raise InputError("this is not a text file in UTF-8", str(path)) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", str(path)) from None


# ---- strict structuring -------------------------------------------------------------------------


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter(forbid_extra_keys=True, detailed_validation=True)
    converter.register_structure_hook(float, _number)
    converter.register_structure_hook(int, _whole)
    converter.register_structure_hook(str, _text)
    converter.register_structure_hook(bool, _truth)
    converter.register_structure_hook_func(_is_list, _list_hook(converter))
    converter.register_structure_hook_func(_is_union, _union_hook(converter))
    converter.register_structure_hook_func(_is_literal, _one_of)
    return converter


def _number(value: Any, _: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"expected a number (got {_show(value)})")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"expected a finite number (got {_show(value)})")
    return number


def _whole(value: Any, _: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"expected a whole number (got {_show(value)})")
    return value


def _text(value: Any, _: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"expected text in quotes (got {_show(value)})")
    return value


def _truth(value: Any, _: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"expected true or false (got {_show(value)})")
    return value


def _show(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _is_list(kind: Any) -> bool:
    return typing.get_origin(kind) in (list, tuple)


def _list_hook(converter: cattrs.Converter) -> Any:
    """Refuse what iterates but is no array, then leave the elements to cattrs."""

    def hook(value: Any, kind: Any) -> Any:
        origin, parts = typing.get_origin(kind), typing.get_args(kind)
        if not isinstance(value, list):
            raise ValueError(f"expected an array in brackets (got {_show(value)})")
        if origin is tuple and len(value) != len(parts):
            raise ValueError(f"expected {len(parts)} values (got {len(value)})")
        kinds = parts if origin is tuple else parts * len(value)
        problems: list[Exception] = []
        made = []
        for k, (element, part) in enumerate(zip(value, kinds, strict=True)):
            try:
                made.append(converter.structure(element, part))
            except Exception as error:
                note = IterableValidationNote("", k, part)
                error.__notes__ = [*getattr(error, "__notes__", []), note]
                problems.append(error)
        if problems:
            raise IterableValidationError("array", problems, kind)
        return tuple(made) if origin is tuple else made

    return hook


def _is_literal(kind: Any) -> bool:
    return typing.get_origin(kind) is typing.Literal


def _one_of(value: Any, kind: Any) -> Any:
    if not _fits(value, kind):
        raise ValueError(f"expected {_words(kind)} (got {_show(value)})")
    return value


def _is_union(kind: Any) -> bool:
    return typing.get_origin(kind) in (typing.Union, types.UnionType)


def _union_hook(converter: cattrs.Converter) -> Any:
    """Choose the member of a union by the form of the value, so that its errors stay precise."""

    def hook(value: Any, kind: Any) -> Any:
        members = typing.get_args(kind)
        if value is None and type(None) in members:
            return None
        fitting = [m for m in members if _fits(value, m)]
        if not fitting:
            words = " or ".join(dict.fromkeys(w for m in members if (w := _words(m))))
            raise ValueError(f"expected {words} (got {_show(value)})")
        return converter.structure(value, fitting[0])

    return hook


def _fits(value: Any, kind: Any) -> bool:
    origin = typing.get_origin(kind)
    if origin is typing.Literal:
        return value in typing.get_args(kind) if isinstance(value, str) else False
    if origin in (list, tuple):
        if not isinstance(value, list):
            return False
        part = typing.get_args(kind)[0]
        if _is_union(part):
            return True  # its elements choose for themselves
        nested = typing.get_origin(part) is list
        return not value or nested == isinstance(value[0], list)
    if origin is dict or attrs.has(kind):
        return isinstance(value, dict)
    if kind in (float, int):
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, kind) if isinstance(kind, type) else False


def _words(kind: Any) -> str:
    origin = typing.get_origin(kind)
    if kind is type(None):
        return ""
    if origin is typing.Literal:
        return " or ".join(f'"{v}"' for v in typing.get_args(kind))
    if origin in (list, tuple, dict):
        return "a table" if origin is dict else "an array"
    names = {Uniform: "{uniform = [low, high]}", Count: "{count = k}", Port: "a table"}
    return names.get(kind) or {float: "a number", int: "a whole number", str: "text"}.get(kind, "")


# ---- problems with their places -----------------------------------------------------------------


def _problems(error: BaseException, place: str) -> list[tuple[str, str]]:
    if isinstance(error, ClassValidationError | IterableValidationError):
        found = []
        for inner in error.exceptions:
            found += _problems(inner, place + _step(inner))
        return found
    if isinstance(error, ForbiddenExtraKeysError):
        known = [a.name for a in attrs.fields(error.cl)]
        return [(f"{place}.{key}", _unknown(key, known)) for key in sorted(error.extra_fields)]
    if isinstance(error, KeyError):
        return [(f"{place}.{error.args[0]}", "this key is missing")]
    if isinstance(error, ValueError):
        return [(place, str(error))]
    return [(place, f"expected a table (got {error})")]


def _step(error: BaseException) -> str:
    """Return the part of the path that the notes of an error name."""
    for note in getattr(error, "__notes__", []):
        if isinstance(note, AttributeValidationNote) and not isinstance(error, KeyError):
            return f".{note.name}"
        if isinstance(note, IterableValidationNote):
            index = note.index
            return f"[{index}]" if isinstance(index, int) else f".{index}"
    return ""


def _unknown(key: str, known: list[str]) -> str:
    near = get_close_matches(key, known, 1)
    hint = f"did you mean {near[0]}?" if near else f"known keys: {', '.join(known)}"
    return f"unknown key; {hint}"
