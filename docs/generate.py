"""Write the pages of the documentation that are made from the code: `python docs/generate.py`.

`commands.md` comes from the parser of the command line, `defects.md` from the corpus of the tests.
Edit those, not the pages.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

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
| 1 | the verdict is not good: not certified, not converged, diverged, outside the band |
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


PAGES = {"commands.md": commands_page, "defects.md": defects_page}

if __name__ == "__main__":
    main()
