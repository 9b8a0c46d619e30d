"""Compiling shared libraries: the system's C compiler, else that of the `ziglang` package."""

from __future__ import annotations

import importlib.util
import logging
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import attrs

from posmas_fmi.errors import BuildError
from posmas_fmi.fmu.scratch import Scratch

_LOG = logging.getLogger(__name__)


@attrs.frozen
class Platform:
    """Where a binary runs.

    Attributes
    ----------
    name : str
        Architecture and system as in FMI 3: ``x86_64-linux``.
    fmi2 : str
        Folder of the binary in an FMI 2 archive.
    extension : str
        Of a shared library.
    target : str
        What zig calls it.
    """

    name: str
    fmi2: str
    extension: str
    target: str

    def folder(self, fmi: int) -> str:
        """Folder of the binary below ``binaries/``."""
        return self.fmi2 if fmi == 2 else self.name


# glibc 2.17 is what manylinux2014 wheels ask for; any Linux in use has it.
PLATFORMS = {
    p.name: p
    for p in (
        Platform("x86_64-linux", "linux64", ".so", "x86_64-linux-gnu.2.17"),
        Platform("x86_64-windows", "win64", ".dll", "x86_64-windows-gnu"),
        Platform("x86_64-darwin", "darwin64", ".dylib", "x86_64-macos"),
        # FMI 2 has no name for these; importers on such machines look where they always do.
        Platform("aarch64-darwin", "darwin64", ".dylib", "aarch64-macos"),
        Platform("aarch64-linux", "linux64", ".so", "aarch64-linux-gnu.2.17"),
    )
}

# No -march=native and no -ffast-math: the same numbers on every machine, NaN and Inf respected.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden", "-s")
TIMEOUT = 600.0  # s; the first run of zig builds its own C library


def host() -> Platform:
    """Return the platform of this process.

    Raises
    ------
    BuildError
        If it is not one of `PLATFORMS`.
    """
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(
        platform.machine().lower(), platform.machine().lower()
    )
    name = f"{machine}-{platform.system().lower()}"
    if name not in PLATFORMS:
        raise BuildError(f"expected one of {', '.join(PLATFORMS)} as the platform (this is {name})")
    return PLATFORMS[name]


@attrs.frozen
class Compiler:
    """A command that compiles C, and how it is told the target."""

    command: tuple[str, ...]
    zig: bool = False

    def arguments(self, target: Platform) -> list[str]:
        """Arguments for a shared library of that platform."""
        arguments = [*self.command]
        if self.zig:  # without a target zig would compile for this very processor
            arguments += ["-target", _zig_target(target)]
        arguments += ["-shared", *FLAGS]
        if target.extension != ".dll":
            arguments.append("-fPIC")
        if target.extension == ".so":
            arguments.append("-Wl,--build-id=none")
        return arguments


def _zig_target(target: Platform) -> str:
    on_musl = sys.platform == "linux" and platform.libc_ver()[0] != "glibc"
    if on_musl and target == host():
        return target.target.split("-gnu")[0] + "-musl"
    return target.target


def find_compiler(target: Platform) -> Compiler:
    """Return a compiler for that platform.

    For the host: the command in the environment variable ``CC``, else cc, gcc or clang on the
    path. For any platform: zig, from the `ziglang` package.

    Raises
    ------
    BuildError
        If there is none; the message says what to install.
    """
    if target == host():
        if os.environ.get("CC"):
            return Compiler(tuple(shlex.split(os.environ["CC"])))
        for name in ("cc", "gcc", "clang"):
            found = shutil.which(name)
            if found:
                return Compiler((found,))
    if importlib.util.find_spec("ziglang"):
        return Compiler((sys.executable, "-m", "ziglang", "cc"), zig=True)
    raise BuildError(
        f"found no C compiler for {target.name}: install one (gcc, clang) or run "
        "'pip install posmas-fmi[compiler]', which brings ziglang"
    )


def buildable(fmi: int) -> list[str]:
    """Return the platforms that this machine can compile for: its own, and with zig all others.

    FMI 2 has one folder per system, which then holds the host's architecture or else x86_64.
    """
    if not importlib.util.find_spec("ziglang"):
        return [host().name]
    if fmi == 3:
        return list(PLATFORMS)
    folders = {host().fmi2: host().name}
    for p in PLATFORMS.values():
        folders.setdefault(p.fmi2, p.name)
    return list(folders.values())


def shared_library(
    files: Mapping[str, str],
    compiled: Sequence[str],
    name: str,
    target: Platform,
    flags: Sequence[str] = (),
) -> bytes:
    """Compile a shared library.

    Parameters
    ----------
    files : mapping of str to str
        Every source file by name.
    compiled : sequence of str
        Those that are given to the compiler.
    name : str
        Of the library, without extension.
    target : Platform
    flags : sequence of str, optional
        Given to the compiler after `FLAGS`.

    Returns
    -------
    bytes
        The library; a function of its arguments and the compiler alone.

    Raises
    ------
    BuildError
        If there is no compiler or it fails; the message holds what it said.
    """
    compiler = find_compiler(target)
    scratch = Scratch("posmas-fmi-build-")
    try:
        folder = scratch.folder
        for file, text in files.items():
            Path(folder, file).write_text(text, encoding="utf-8", newline="\n")
        output = name + target.extension
        command = [*compiler.arguments(target), *flags, "-o", output, *compiled, "-lm"]
        _LOG.info("compiling %s for %s: %s", name, target.name, shlex.join(command))
        try:
            run = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, timeout=TIMEOUT, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise BuildError(f"running {command[0]} failed: {error}", name) from error
        result = Path(folder, output)
        if run.returncode != 0 or not result.is_file():
            said = (run.stderr or run.stdout).strip()[-2000:]
            raise BuildError(f"{shlex.join(command)} failed:\n{said}", name)
        return result.read_bytes()
    finally:
        scratch.cleanup()
