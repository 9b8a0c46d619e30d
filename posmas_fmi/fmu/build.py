"""From a model to a .fmu file: found among the prebuilt ones, in the cache, or built now."""

from __future__ import annotations

import hashlib
import io
import logging
import os
import sys
import tempfile
import time
import tomllib
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from posmas_fmi import resources
from posmas_fmi.errors import BuildError, InputError
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu.compile import (
    FLAGS,
    PLATFORMS,
    Platform,
    buildable,
    host,
    shared_library,
)
from posmas_fmi.fmu.description import build_description, model_description
from posmas_fmi.fmu.model import FmuModel
from posmas_fmi.fmu.plant import agent_functions, read_plant, shipped_plants
from posmas_fmi.fmu.positive_agent import positive_agent
from posmas_fmi.fmu.sources import FmiVersion, compiled, sources

_LOG = logging.getLogger(__name__)


def agent_fmu(
    g: VectorFunction,
    sec: VectorFunction,
    m: int,
    p: int,
    q: int,
    fmi: int = 3,
    platforms: Sequence[str] | None = None,
    cache: Path | None = None,
) -> Path:
    """Return the .fmu of model (1) with these nonlinearities; A, H, B, C are its parameters.

    Parameters
    ----------
    g, sec : VectorFunction
        See `posmas_fmi.fmu.positive_agent.positive_agent`.
    m, p, q : int
        Numbers of states, inputs, outputs.
    fmi : {2, 3}
    platforms : sequence of str, optional
        Names from `posmas_fmi.fmu.compile.PLATFORMS`; default the host.
    cache : Path, optional
        Folder to keep built FMUs in; default the user's cache.

    Returns
    -------
    Path

    Raises
    ------
    BuildError
        If it has to be built and cannot be.
    """
    return fmu(positive_agent(g, sec, m, p, q), fmi, platforms, cache)


def fmu(
    model: FmuModel,
    fmi: int = 3,
    platforms: Sequence[str] | None = None,
    cache: Path | None = None,
) -> Path:
    """Return the .fmu of a model: prebuilt, cached, or built now; parameters as `agent_fmu`."""
    version, wanted = _version(fmi), platforms_for(platforms, fmi)
    name = file_name(model, version, wanted)
    folder = cache if cache is not None else cache_folder()
    for place in (resources.prebuilt() / name, folder / name):
        if place.is_file():
            return place
    path = folder / name
    write(path, archive(model, version, wanted))
    return path


def file_name(model: FmuModel, fmi: FmiVersion, platforms: Sequence[Platform]) -> str:
    """Name of the archive: the model, the FMI version and a hash of all that goes into it."""
    files = sources(model, fmi)
    key = hashlib.sha256(model_description(model, fmi, compiled(files)))  # tells the sources' hash
    key.update("\n".join((*(p.name for p in platforms), *FLAGS)).encode())
    return f"{model.name}-fmi{fmi}-{key.hexdigest()[:16]}.fmu"


def archive(model: FmuModel, fmi: FmiVersion, platforms: Sequence[Platform]) -> bytes:
    """Build the archive: description, binaries, sources. The same arguments give the same bytes."""
    files = sources(model, fmi)
    units = compiled(files)
    content: dict[str, bytes] = {"modelDescription.xml": model_description(model, fmi, units)}
    content |= {f"sources/{name}": text.encode() for name, text in files.items()}
    if fmi == 3:
        content["sources/buildDescription.xml"] = build_description(model, units)
    for target in platforms:
        place = f"binaries/{target.folder(fmi)}/{model.name}{target.extension}"
        content[place] = shared_library(files, units, model.name, target)
    return _zip(content)


def write(path: Path, data: bytes) -> None:
    """Write a file so that other processes see all of it or nothing.

    Raises
    ------
    BuildError
        If the folder cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _forget_parts(path.parent)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise BuildError(f"cannot write the FMU: {error}", str(path)) from error


def _forget_parts(folder: Path) -> None:
    """Remove what builds that were killed have left: nothing is written for an hour."""
    for part in folder.glob(".*.part"):
        with suppress(OSError):
            if time.time() - part.stat().st_mtime > 3600:
                part.unlink()


def cache_folder() -> Path:
    """Return the user's cache folder of this package, by the custom of the system."""
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return base / "posmas-fmi" / "fmu"


# ---- what ships ---------------------------------------------------------------------------------


def build_shipped(models_dir: Path, out_dir: Path) -> list[Path]:
    """Build the agents of all scenarios in a folder and the shipped plants, for this machine.

    Each as FMI 2 and FMI 3.

    Parameters
    ----------
    models_dir : Path
        Folder of ``*.toml`` with an ``[agent]`` section each.
    out_dir : Path
        Where the .fmu files go, by the names that `agent_fmu` looks for.

    Returns
    -------
    list of Path
        Each distinct FMU once.

    Raises
    ------
    BuildError
        If a scenario cannot be read or compiled.
    """
    models = [*_agents_of(models_dir), *(read_plant(p) for p in shipped_plants().values())]
    paths: list[Path] = []
    for model in models:
        for fmi in (2, 3):
            version = _version(fmi)
            path = out_dir / file_name(model, version, (host(),))
            if path in paths:
                continue
            if not path.is_file():
                write(path, archive(model, version, (host(),)))
            paths.append(path)
    return paths


def _agents_of(models_dir: Path) -> Iterator[FmuModel]:
    for file in sorted(models_dir.glob("*.toml")):
        try:
            agent = tomllib.loads(file.read_text(encoding="utf-8")).get("agent")
        except (OSError, ValueError) as error:
            raise BuildError(f"cannot read the scenario: {error}", str(file)) from error
        if not isinstance(agent, dict):
            continue  # a scenario of plants that bring their own FMU
        yield positive_agent(*agent_functions(agent, f"{file}: $.agent"))


def build_plants(
    names: Sequence[str], out_dir: Path, platforms: Sequence[str] | None = None
) -> list[Path]:
    """Build shipped plants, ``<name>-fmi2.fmu`` and ``<name>-fmi3.fmu`` each.

    Parameters
    ----------
    names : sequence of str
        Plants from `posmas_fmi.fmu.plant.shipped_plants`; empty for all.
    out_dir : Path
        Where the files go; files of that name are replaced.
    platforms : sequence of str, optional
        Default: all that this machine can compile for, see `buildable`.

    Returns
    -------
    list of Path

    Raises
    ------
    InputError
        If there is no such plant.
    BuildError
        If one cannot be built.
    """
    plants = shipped_plants()
    for name in names:
        if name not in plants:
            raise InputError(f"there is no plant {name!r}; shipped: {', '.join(plants)}")
    paths = []
    for name in names or plants:
        model = read_plant(plants[name])
        for fmi in (2, 3):
            targets = platforms_for(buildable(fmi) if platforms is None else platforms, fmi)
            path = out_dir / f"{name}-fmi{fmi}.fmu"
            write(path, archive(model, _version(fmi), targets))
            paths.append(path)
    return paths


def platforms_for(names: Sequence[str] | None, fmi: int) -> tuple[Platform, ...]:
    """Return the platforms of these names, the host by default, that one FMU can have binaries for.

    Raises
    ------
    BuildError
        If there is no such platform, or two have the same folder in this version of FMI.
    """
    if names is None:
        return (host(),)
    unknown = sorted(set(names) - set(PLATFORMS))
    if unknown or not names:
        raise BuildError(f"expected platforms from {', '.join(PLATFORMS)} (got {list(names)})")
    chosen = tuple(PLATFORMS[name] for name in PLATFORMS if name in names)
    folders = [p.folder(fmi) for p in chosen]
    if len(set(folders)) < len(folders):
        raise BuildError(f"FMI {fmi} has one folder only for two of {', '.join(names)}; take one")
    return chosen


# ---- details ------------------------------------------------------------------------------------


def _version(fmi: int) -> FmiVersion:
    if fmi == 2:
        return 2
    if fmi == 3:
        return 3
    raise BuildError(f"expected FMI version 2 or 3 (got {fmi!r})")


def _zip(content: Mapping[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as file:
        for name in sorted(content):
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3
            entry.external_attr = 0o100644 << 16
            file.writestr(entry, content[name])
    return buffer.getvalue()
