"""Write the pages of the documentation that are made from the code: `python docs/generate.py`.

`commands.md` comes from the parser of the command line, `scenario_keys.md` from the classes in
`posmas_fmi/scenario/tables.py`, `defects.md` from the corpus of the tests. Edit those, not the
pages.
"""

from __future__ import annotations

import argparse
import inspect
import itertools
import re
import sys
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import attrs

DOCS = Path(__file__).resolve().parent
NOTE = "<!-- Made by docs/generate.py from {source}: edit that, then run the script. -->\n"


def main() -> None:
    """Write every page."""
    for name, make in PAGES.items():
        (DOCS / name).write_text(make(), encoding="utf-8", newline="\n")


# ---- commands -------------------------------------------------------------------------------


COMMANDS = """
# Commands

Results go to standard output, progress and errors to standard error.
`--json` gives what a program can read.
SCENARIO is a file or the name of a shipped scenario, see `posmas-fmi models`.

| exit code | meaning |
|---|---|
| 0 | done, and the verdict is good |
| 1 | the verdict is not good: not certified, not converged, diverged, not settled, outside band |
| 2 | bad input: the message says where and what to do |
| 3 | an FMU failed or cannot be used |
| 130 | cancelled |

`posmas-fmi --verbose COMMAND` logs what happens, `posmas-fmi --version` prints the version.
"""


def commands_page() -> str:
    """Return the page of all commands, from the parser itself."""
    from posmas_fmi import cli

    parts = [NOTE.format(source="posmas_fmi/cli.py"), COMMANDS]
    parts += [_command(parser) for parser in _leaves(cli._parser())]
    return "\n".join(parts)


def _leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Go through the parsers of commands that have no commands below them."""
    below = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    if not below:
        yield parser
    for action in below:
        for child in action.choices.values():
            yield from _leaves(child)


def _command(parser: argparse.ArgumentParser) -> str:
    text = (parser.description or "").strip()
    actions = [a for a in parser._actions if not isinstance(a, argparse._HelpAction)]
    actions = [a for a in actions if a.help is not argparse.SUPPRESS]
    positional = [a for a in actions if not a.option_strings]
    options = [a for a in actions if a.option_strings]
    words = [_usage(a) for a in [*positional, *options]]
    lines = [f"## `{parser.prog}`", "", f"{text[:1].upper()}{text[1:]}.", ""]
    lines += ["```text", *_wrapped(f"{parser.prog} ", words), "```", ""]
    rows = [(_name(a), a.help or "") for a in [*positional, *options]]
    if rows:
        lines += ["| argument | meaning |", "|---|---|"]
        lines += [f"| `{name}` | {_cell(meaning)} |" for name, meaning in rows] + [""]
    return "\n".join(lines)


def _value(action: argparse.Action) -> str:
    if action.choices:
        return "{" + ",".join(map(str, action.choices)) + "}"
    if isinstance(action.metavar, str):
        return action.metavar
    return action.dest.upper()


def _usage(action: argparse.Action) -> str:
    value = "" if action.nargs == 0 else _value(action)
    if action.nargs == "+":
        value = f"{value}..."
    if action.nargs == "*":
        value = f"[{value}...]"
    if not action.option_strings:
        return value
    text = f"{action.option_strings[-1]} {value}".strip()
    return text if action.required else f"[{text}]"


def _name(action: argparse.Action) -> str:
    if not action.option_strings:
        return _value(action)
    return (
        f"{', '.join(action.option_strings)} {'' if action.nargs == 0 else _value(action)}".strip()
    )


def _wrapped(start: str, words: list[str], width: int = 80) -> list[str]:
    lines, line = [], start
    for word in words:
        if len(line) + len(word) > width and line.strip():
            lines.append(line.rstrip())
            line = " " * len(start)
        line += word + " "
    return [*lines, line.rstrip()]


def _cell(text: str) -> str:
    text = " ".join(text.split()).replace("|", "\\|")
    return text.replace("<", "&lt;").replace(">", "&gt;")


# ---- defects --------------------------------------------------------------------------------


DEFECTS = """
# Defects and findings

What `posmas-fmi check` says about FMUs that are made to have one defect each.
`tests/hostile/` builds them from our own C and XML, and `tests/test_hostile.py` checks every line
of these tables: the finding is there, the exit code is this one, and neither the process that
checks nor any file or process of the trial is left behind.

Place is a part of where the finding points to.
Exit codes: 0 fine, 1 usable with errors, 3 not usable; see [check](check.md).
"""


def defects_page() -> str:
    """Return the page of defects, from the corpus of the tests."""
    sys.path.insert(0, str(DOCS.parent / "tests"))
    try:
        from hostile.corpus import GROUPS
    finally:
        del sys.path[0]
    parts = [NOTE.format(source="tests/hostile/corpus.py"), DEFECTS]
    parts.append(f"{sum(map(len, GROUPS.values()))} defects:")
    for title, group in GROUPS.items():
        parts += [f"\n## {title}\n", "| defect | finding | severity | place | exit |"]
        parts.append("|---|---|---|---|---|")
        parts += [
            f"| {_cell(d.text)} | `{d.code}` | {d.severity} | {d.place} | {d.exit_code} |"
            for d in group
        ]
    return "\n".join([*parts, ""])


# ---- keys of a scenario file ----------------------------------------------------------------

KEYS = """
# Keys of a scenario file

Every table and key that a scenario file may hold.
[The scenario file](scenario.md) explains how they belong together.
Unknown keys are refused, with the nearest known one.
"""


@attrs.frozen
class Key:
    """One key of a table."""

    name: str
    kind: str
    default: str
    meaning: str
    below: tuple[type, ...]  # tables that stand in its value, as `{...}`


@attrs.frozen
class Table:
    """One table of a scenario file."""

    path: str  # as written: [plant], [[plant.override]], {count = …}
    place: type
    keys: tuple[Key, ...]


def scenario_page() -> str:
    """Return the page of all keys of a scenario file, from the classes that it is read into."""
    parts = [NOTE.format(source="posmas_fmi/scenario/tables.py"), KEYS]
    parts += [_table_text(table) for table in scenario_tables()]
    return "\n".join(parts)


def scenario_tables() -> list[Table]:
    """Return every table, each followed by those that stand inside it."""
    from posmas_fmi.design import DesignSettings
    from posmas_fmi.scenario.tables import ScenarioFile

    read_later = {"design": DesignSettings}  # a plain table in ScenarioFile
    found: list[Table] = []
    for field, hint in _fields(ScenarioFile):
        if field.name in read_later:
            _add(found, f"[{field.name}]", read_later[field.name])
        else:
            _add_from(found, field.name, hint)
    return found


def _add_from(found: list[Table], path: str, hint: Any) -> None:
    """Add the tables of a key, if its value is a table with keys of its own."""
    form, place = _form(hint)
    if place is not None:
        written = {"one": "[{}]", "list": "[[{}]]", "named": "[{}.NAME]"}[form]
        _add(found, written.format(path), place)


def _add(found: list[Table], path: str, place: type) -> None:
    meanings = _meanings(place)
    keys, deeper = [], []
    for field, hint in _fields(place):
        if _form(hint)[1] is not None:
            deeper.append((f"{path.strip('[]')}.{field.name}", hint))
            continue
        inner = tuple(dict.fromkeys(_inner(hint)))
        meaning = meanings.get(field.name, "")
        keys.append(Key(field.name, _kind(hint), _default(field), meaning, inner))
    found.append(Table(path, place, tuple(keys)))
    known = {table.place for table in found}
    for inner in dict.fromkeys(cls for key in keys for cls in key.below):
        if inner not in known:
            _add(found, _inline(inner), inner)
    for below, hint in deeper:
        _add_from(found, below, hint)


def _fields(place: type) -> list[tuple[attrs.Attribute[Any], Any]]:
    hints = typing.get_type_hints(place)
    return [(field, hints[field.name]) for field in attrs.fields(place)]


def _form(hint: Any) -> tuple[str, type | None]:
    """Whether a value is a table of the file, `one`, a `list` of them or `named` ones."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        arguments = tuple(a for a in arguments if a is not type(None))
        return _form(arguments[0]) if len(arguments) == 1 else ("", None)
    form = {list: "list", dict: "named"}.get(origin, "one")
    place = arguments[-1] if origin in (list, dict) else hint
    table = inspect.isclass(place) and attrs.has(place)
    return (form, place) if table and (place.__doc__ or "").startswith("``[") else ("", None)


def _inner(hint: Any) -> Iterator[type]:
    if inspect.isclass(hint) and attrs.has(hint):
        yield hint
    for argument in typing.get_args(hint):
        yield from _inner(argument)


def _inline(place: type) -> str:
    required = [f.name for f in attrs.fields(place) if f.default is attrs.NOTHING]
    return "{" + ", ".join(f"{name} = …" for name in required or ["…"]) + "}"


_WORDS = {str: "text", int: "whole number", float: "number", bool: "true or false"}


def _kind(hint: Any, many: bool = False) -> str:
    """Return what a value may be, in words."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint in _WORDS:
        word = _WORDS[hint]
        return f"{word}s" if many and hint is not bool else word
    if origin in (typing.Union, types.UnionType):
        kinds = [_kind(a, many) for a in arguments if a is not type(None)]
        return " or ".join(dict.fromkeys(kinds))
    if origin is Literal:
        return " or ".join(f'`"{value}"`' for value in arguments)
    if hint == list[list[float]] or "ndarray" in str(hint):
        return "matrices" if many else "matrix"
    if origin is list:
        return f"{'lists' if many else 'list'} of {_kind(arguments[0], True)}"
    if origin is tuple and ... in arguments:
        return _kind(list[arguments[0]], many)  # type: ignore[valid-type]
    if origin is tuple:
        pair = ", ".join(_kind(a) for a in arguments if a is not ...)
        return f"{'pairs' if many else 'pair'} `[{pair}]`"
    if inspect.isclass(hint) and attrs.has(hint):
        return f"[`{_inline(hint)}`](#{_anchor(_inline(hint))})"
    if hint is dict or origin is dict:
        inner = list(dict.fromkeys(_inner(hint)))
        of = f" of {_kind(arguments[-1], True)}" if inner else ""
        return f"{'tables' if many else 'table'}{of}"
    return "any value" if hint is Any else "value"


def _default(field: attrs.Attribute[Any]) -> str:
    value = field.default
    if value is attrs.NOTHING:
        return "required"
    if value is None or isinstance(value, attrs.Factory):  # type: ignore[arg-type]
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"`[{', '.join(f'{v:g}' for v in value)}]`"
    return f'`"{value}"`' if isinstance(value, str) else f"{value:g}"


def _meanings(place: type) -> dict[str, str]:
    """Return name -> meaning from the section Attributes or Parameters of a docstring."""
    text = inspect.cleandoc(place.__doc__ or "")
    section = re.search(
        r"^(?:Attributes|Parameters)\n-+\n(.*?)(?=^\w+\n-+\n|\Z)", text, re.S | re.M
    )
    found: dict[str, str] = {}
    names: list[str] = []
    for line in (section.group(1) if section else "").splitlines():
        if line and not line[0].isspace():
            names = [name.strip() for name in line.partition(" : ")[0].split(",")]
        elif line.strip():
            found |= {name: f"{found.get(name, '')} {line.strip()}".strip() for name in names}
    return found


def _summary(place: type) -> str:
    """Return the first paragraphs of a docstring, without the name of the table."""
    text = inspect.cleandoc(place.__doc__ or "")
    text = re.split(r"^\w+\n-+$", text, maxsplit=1, flags=re.M)[0].strip()
    text = re.sub(r"^(``[^`]*``(, | and )?)+:\s*", "", text)
    return text[:1].upper() + text[1:]


def _anchor(path: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", path.lower()).strip("-")


def _table_text(table: Table) -> str:
    top = table.path[0] == "[" and "." not in table.path.replace(".NAME]", "]")
    level = "##" if top else "###"
    lines = [f"{level} `{table.path}` {{#{_anchor(table.path)}}}", "", _summary(table.place), ""]
    if table.keys:
        lines += ["| key | value | default | meaning |", "|---|---|---|---|"]
        lines += [f"| {' | '.join(map(_cell, row))} |" for row in _rows(table.keys)]
    return "\n".join([*lines, ""])


def _rows(keys: tuple[Key, ...]) -> Iterator[tuple[str, str, str, str]]:
    """Go through the rows; keys that the docstring explains together share one."""
    for (kind, meaning, _), group in itertools.groupby(
        keys, lambda key: (key.kind, key.meaning, "" if key.meaning else key.name)
    ):
        rows = list(group)
        names = ", ".join(f"`{key.name}`" for key in rows)
        defaults = [key.default for key in rows]
        yield names, kind, ", ".join(dict.fromkeys(filter(None, defaults))), meaning


PAGES = {
    "commands.md": commands_page,
    "scenario_keys.md": scenario_page,
    "defects.md": defects_page,
}

if __name__ == "__main__":
    main()
