"""The C libraries of the master: prebuilt, cached or built now, and loaded."""

from __future__ import annotations

import hashlib
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path

import attrs

from posmas_fmi import resources
from posmas_fmi.cosim.loading import load
from posmas_fmi.errors import BuildError
from posmas_fmi.fmu.build import cache_folder, write
from posmas_fmi.fmu.compile import FLAGS, host, shared_library
from posmas_fmi.fmu.plant import agent_functions
from posmas_fmi.fmu.positive_agent import functions_header

__all__ = [
    "Sources",
    "build_shipped",
    "engine_sources",
    "fmus_sources",
    "library",
    "load",
    "worker_sources",
]

_HERE = Path(__file__).parent / "csrc"
_EXPORT = Path(resources.__file__).parent / "fmu" / "csrc" / "export.h"
_FMUS = ("fmus.h", "fmus.c", "message_log.h", "message_log.c")
_ENGINE = ("engine.h", "engine.c", "threads.h", "threads.c", "lanes.h")
_WAITING = ("waiting.h", "waiting.c")
_SURROUNDINGS = ("surroundings.h", "surroundings.c")
_MORE_FLAGS = ("-O3", "-pthread")  # of the engine: unrolls the small matrix products


@attrs.frozen
class Sources:
    """A library as C sources.

    Attributes
    ----------
    name : str
    files : mapping of str to str
        Content by file name; those that end in ``.c`` are compiled.
    flags : tuple of str
        Beyond `posmas_fmi.fmu.compile.FLAGS`.
    """

    name: str
    files: Mapping[str, str]
    flags: tuple[str, ...] = ()

    @property
    def file_name(self) -> str:
        """Name of the library for this machine, with a hash of all that goes into it."""
        target = host()
        content = [target.name, *FLAGS, *self.flags]
        for name, text in sorted(self.files.items()):
            content += [name, text]
        key = hashlib.sha256("\0".join(content).encode()).hexdigest()[:16]
        return f"{self.name}-{key}{target.extension}"

    def build(self) -> bytes:
        """Compile; errors as `posmas_fmi.fmu.compile.shared_library`."""
        units = sorted(name for name in self.files if name.endswith(".c"))
        return shared_library(self.files, units, self.name, host(), self.flags)


def fmus_sources() -> Sources:
    """Return the sources of the loop over FMUs, which is the same for every agent."""
    return Sources("fmus", _read(_FMUS))


def worker_sources() -> Sources:
    """Return the sources of the loop over FMUs in worker processes, for both sides of it."""
    return Sources(
        "worker",
        _read((*_FMUS, "remote.h", "remote.c", "worker_loop.c", *_WAITING, *_SURROUNDINGS)),
    )


def engine_sources(kind: str, header: str) -> Sources:
    """Return the sources of the engine for one kind of controller.

    Parameters
    ----------
    kind : str
        Folder of ``controller.h`` and ``controller.c``.
    header : str
        ``agent_functions.h``: the sizes, and what the controller needs of the agent.
    """
    folder = _HERE / kind
    own = {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.[ch]"))}
    files = {**_read((*_FMUS, *_ENGINE)), **own, "agent_functions.h": header}
    return Sources("engine", files, _MORE_FLAGS)


def library(sources: Sources, cache_to: Path | None = None) -> Path:
    """Return the compiled library: prebuilt, cached, or built now.

    Parameters
    ----------
    sources : Sources
    cache_to : Path, optional
        Folder to keep it in; default the user's cache.

    Raises
    ------
    BuildError
        If it has to be built and cannot be.
    """
    name = sources.file_name
    folder = cache_to if cache_to is not None else cache_folder().parent / "engine"
    for place in (resources.prebuilt() / name, folder / name):
        if place.is_file():
            return place
    path = folder / name
    write(path, sources.build())
    return path


def build_shipped(models_dir: Path, out_dir: Path) -> list[Path]:
    """Build the libraries that the scenarios of a folder need, for this machine.

    Parameters
    ----------
    models_dir : Path
        Folder of ``*.toml`` with an ``[agent]`` section each.
    out_dir : Path
        Where the libraries go.

    Returns
    -------
    list of Path

    Raises
    ------
    BuildError
        If a scenario cannot be read or compiled.
    """
    wanted = [fmus_sources()]
    if os.name == "posix":
        wanted.append(worker_sources())
    for file in sorted(models_dir.glob("*.toml")):
        try:
            agent = tomllib.loads(file.read_text(encoding="utf-8")).get("agent")
        except (OSError, ValueError) as error:
            raise BuildError(f"cannot read the scenario: {error}", str(file)) from error
        if isinstance(agent, dict):
            functions = agent_functions(agent, f"{file}: $.agent")
            wanted.append(engine_sources("protocol", functions_header(*functions, lanes=True)))
    paths: list[Path] = []
    for sources in wanted:
        path = out_dir / sources.file_name
        if path not in paths:
            if not path.is_file():
                write(path, sources.build())
            paths.append(path)
    return paths


def _read(names: tuple[str, ...]) -> dict[str, str]:
    files = {name: (_HERE / name).read_text(encoding="utf-8") for name in names}
    return {**files, "export.h": _EXPORT.read_text(encoding="utf-8")}
