"""Set up and run from a fresh checkout: `python tasks.py run` and `python tasks.py test`.

Needs Python 3.11 or newer and nothing else. Both commands make a virtual environment (once) and
install the package into it; `run` then runs the main job, `test` every check of the project.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent
MAIN_JOB = ["run", "models/paper_example_1.toml"]
CHECKS = {
    "lint": ["-m", "ruff", "check", "."],
    "format": ["-m", "ruff", "format", "--check", "."],
    "types": ["-m", "mypy"],
    "tests": ["-m", "pytest", "-n", "auto", "--maxprocesses", "8", "--dist", "loadfile"],
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--venv", type=Path, default=ROOT / ".venv", help="default: .venv")
    tasks = parser.add_subparsers(dest="task", required=True)
    run = tasks.add_parser("run", help="install, then run posmas-fmi (default: the main job)")
    run.add_argument("arguments", nargs=argparse.REMAINDER, help="arguments of posmas-fmi")
    test = tasks.add_parser("test", help="install with the tools, then lint, types and tests")
    test.add_argument("--fast", action="store_true", help="leave out the tests marked slow")
    test.add_argument("only", nargs="*", help=f"some of: {', '.join(CHECKS)}")
    options = parser.parse_args()
    if sys.version_info < (3, 11):
        print(f"expected Python 3.11 or newer (got {sys.version.split()[0]})", file=sys.stderr)
        return 2
    if options.task == "run":
        python = environment(options.venv, "")
        return call(python, ["-m", "posmas_fmi", *(options.arguments or MAIN_JOB)])
    return check(options, parser)


def check(options: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    """Run every check, also after one has failed, and say at the end which failed."""
    unknown = set(options.only) - set(CHECKS)
    if unknown:
        parser.error(f"expected some of {', '.join(CHECKS)} (got {', '.join(sorted(unknown))})")
    python = environment(options.venv, "[dev]")
    failed = []
    for name in options.only or CHECKS:
        print(f"== {name}", flush=True)
        extra = ["-m", "not slow"] if name == "tests" and options.fast else []
        if call(python, CHECKS[name] + extra):
            failed.append(name)
    print(f"== failed: {', '.join(failed)}" if failed else "== all checks passed", flush=True)
    return 1 if failed else 0


def environment(folder: Path, extra: str) -> Path:
    """Make the virtual environment if it is missing and install the checkout into it."""
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not python.exists():
        print(f"making the environment {folder}", flush=True)
        venv.create(folder, with_pip=True)
    print("installing the package (the first time takes a few minutes)", flush=True)
    subprocess.run(
        [python, "-m", "pip", "install", "--quiet", "--editable", f"{ROOT}{extra}"], check=True
    )
    return python


def call(python: Path, arguments: list[str]) -> int:
    return subprocess.run([str(python), *arguments], cwd=ROOT).returncode


if __name__ == "__main__":
    sys.exit(main())
