"""Findings about the binaries: which systems they are for, and whether the calls are in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import attrs

from posmas_fmi.errors import ArchiveError, BuildError
from posmas_fmi.fmu.archive import entry_names, read_entry
from posmas_fmi.fmu.check.described import Description
from posmas_fmi.fmu.check.finding import Finding
from posmas_fmi.fmu.compile import host
from posmas_fmi.fmu.image import Image, ImageError, read_image

_SYSTEMS = {"linux": "linux", "win": "windows", "darwin": "darwin"}
_EXTENSIONS = {"linux": ".so", "windows": ".dll", "darwin": ".dylib"}
_LARGEST = 2**30  # bytes of one binary
# what licence managers and tools leave in a binary: a hint, not a proof
_LICENCES = {
    b"LM_LICENSE_FILE": "FlexNet",
    b"lc_checkout": "FlexNet",
    b"DYMOLA_RUNTIME_LICENSE": "Dymola",
    b"rlm_checkout": "RLM",
    b"ANSYSLMD_LICENSE": "Ansys",
    b"MLM_LICENSE_FILE": "MATLAB",
    b"SIMPACK_LICENSE": "Simpack",
}


@attrs.frozen
class Binary:
    """A binary in the archive.

    Attributes
    ----------
    path : str
    folder : str
        Below ``binaries/``.
    image : Image or None
        None if it cannot be read.
    problem : str
        Why it cannot be read.
    """

    path: str
    folder: str
    image: Image | None
    problem: str = ""
    licences: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return what the report shows."""
        image = self.image
        return {
            "path": self.path,
            "platform": self.folder,
            "system": image.system if image else None,
            "architectures": list(image.machines) if image else [],
            "needs": list(image.needs) if image else [],
            "problem": self.problem,
        }


def read_binaries(fmu: Path) -> list[Binary]:
    """Read the headers of every binary of an archive that is safe to read."""
    found = []
    for name in entry_names(fmu):
        path = PurePosixPath(name)
        wanted = {".so", ".dll", ".dylib"}
        if len(path.parts) != 3 or path.parts[0] != "binaries" or path.suffix not in wanted:
            continue
        image, problem = None, ""
        licences: tuple[str, ...] = ()
        try:
            data = read_entry(fmu, name, _LARGEST)
            image = read_image(data)
            licences = tuple(sorted({who for mark, who in _LICENCES.items() if mark in data}))
        except (ImageError, ArchiveError) as error:
            problem = str(error)
        found.append(Binary(name, path.parts[1], image, problem, licences))
    return found


def host_folders(fmi: int) -> tuple[str, ...]:
    """Return the folders below ``binaries/`` that this machine looks in, the best first."""
    here = host()
    return (here.name, here.fmi2) if fmi == 3 else (here.fmi2,)


def binary_findings(fmu: Path, told: Description, binaries: list[Binary]) -> list[Finding]:
    """Return the findings about the binaries of an FMU."""
    findings = list(_folders(binaries))
    try:
        folder = host_folders(told.major)[0]
    except BuildError as error:
        return [*findings, Finding("error", "platform", "", error.message)]
    for identifier in dict.fromkeys(i.identifier for i in told.interfaces):
        findings += _for_here(fmu, told, binaries, folder, identifier)
    return findings


def _folders(binaries: list[Binary]) -> Iterator[Finding]:
    for binary in binaries:
        if binary.image is None:
            continue
        expected = _expected(binary.folder)
        if expected is None:
            continue
        system, machine = expected
        image = binary.image
        if image.system != system or machine not in image.machines:
            yield Finding(
                "warning",
                "binary-folder",
                binary.path,
                f"expected {machine}-{system} (it is {'/'.join(image.machines)}-{image.system})",
            )


def _expected(folder: str) -> tuple[str, str] | None:
    """Return system and architecture that the name of a folder promises."""
    old = re.fullmatch(r"(linux|win|darwin)(32|64)", folder)
    if old:
        return _SYSTEMS[old[1]], "x86" if old[2] == "32" else "x86_64"
    new = re.fullmatch(r"(\w+)-(linux|windows|darwin)", folder)
    return (new[2], new[1]) if new else None


def _for_here(
    fmu: Path, told: Description, binaries: list[Binary], folder: str, identifier: str
) -> Iterator[Finding]:
    here = host()
    name = identifier + here.extension
    wanted = f"binaries/{folder}/{name}"
    mine = [b for b in binaries if b.folder == folder]
    binary = next((b for b in mine if b.path == wanted), None)
    if binary is None:
        yield _absent(fmu, binaries, mine, wanted)
        return
    if binary.image is None:
        yield Finding(
            "fatal", "binary-damaged", wanted, binary.problem, "export or copy the FMU again"
        )
        return
    image = binary.image
    system, machine = here.name.split("-")[1], here.name.split("-")[0]
    if image.system != system or machine not in image.machines:
        yield Finding(
            "fatal",
            "binary-architecture",
            wanted,
            f"expected {here.name} (it is {'/'.join(image.machines)}-{image.system})",
            f"export the FMU for {here.name}",
        )
        return
    if image.executable_stack:
        yield Finding(
            "warning",
            "binary-stack",
            wanted,
            "it asks for an executable stack: newer systems refuse to load it",
            "link it with -z noexecstack",
        )
    if binary.licences:
        yield Finding(
            "warning",
            "licence",
            wanted,
            f"it holds the marks of a licence manager ({', '.join(binary.licences)})",
            "see that the licence is there before a long run",
        )
    if image.exports is not None:
        yield from _symbols(told, identifier, wanted, image.exports)


def _absent(fmu: Path, all_: list[Binary], mine: list[Binary], wanted: str) -> Finding:
    if mine:
        others = ", ".join(PurePosixPath(b.path).name for b in mine)
        return Finding(
            "fatal",
            "binary-name",
            wanted,
            f"expected the library to be named by the modelIdentifier (there is {others})",
            "rename the library, or correct the modelIdentifier",
        )
    has = ", ".join(dict.fromkeys(b.folder for b in all_)) or "none"
    sources = any(n.startswith("sources/") and n.endswith(".c") for n in entry_names(fmu))
    return Finding(
        "fatal",
        "binary-missing",
        wanted,
        f"expected a binary for this system (the FMU has {has})",
        "it has C sources: compile them (fmpy can)"
        if sources
        else f"export the FMU for {host().name}",
    )


# ---- the calls ----------------------------------------------------------------------------------

_COMMON = [
    "FreeInstance",
    "EnterInitializationMode",
    "ExitInitializationMode",
    "Terminate",
    "Reset",
]
_NEEDED = {
    (
        "Co-Simulation",
        1,
    ): "InstantiateSlave InitializeSlave DoStep TerminateSlave FreeSlaveInstance GetReal SetReal",
    ("Model Exchange", 1): "InstantiateModel Initialize SetTime SetContinuousStates GetDerivatives "
    "FreeModelInstance GetReal SetReal",
    ("Co-Simulation", 2): "Instantiate SetupExperiment DoStep GetReal SetReal",
    ("Model Exchange", 2): "Instantiate SetupExperiment SetTime SetContinuousStates GetDerivatives "
    "EnterContinuousTimeMode NewDiscreteStates GetReal SetReal",
    ("Co-Simulation", 3): "InstantiateCoSimulation DoStep GetFloat64 SetFloat64",
    ("Model Exchange", 3): "InstantiateModelExchange SetTime SetContinuousStates "
    "GetContinuousStateDerivatives EnterContinuousTimeMode UpdateDiscreteStates GetFloat64 "
    "SetFloat64",
    ("Scheduled Execution", 3): "InstantiateScheduledExecution ActivateModelPartition",
}
_PROMISED = {  # capability -> functions, by version
    "canGetAndSetFMUstate": {
        2: "GetFMUstate SetFMUstate FreeFMUstate",
        3: "GetFMUState SetFMUState FreeFMUState",
    },
    "canSerializeFMUstate": {
        2: "SerializedFMUstateSize SerializeFMUstate DeSerializeFMUstate",
        3: "SerializedFMUStateSize SerializeFMUState DeserializeFMUState",
    },
    "canSerializeFMUState": {3: "SerializedFMUStateSize SerializeFMUState DeserializeFMUState"},
    "providesDirectionalDerivative": {2: "GetDirectionalDerivative"},
    "providesDirectionalDerivatives": {3: "GetDirectionalDerivative"},
    "providesAdjointDerivatives": {3: "GetAdjointDerivative"},
}


def _symbols(
    told: Description, identifier: str, path: str, exports: frozenset[str]
) -> Iterator[Finding]:
    prefix = f"{identifier}_fmi" if told.major == 1 else f"fmi{told.major}"
    for interface in (i for i in told.interfaces if i.identifier == identifier):
        needed = _NEEDED[interface.kind, told.major].split()
        if told.major > 1:
            needed += _COMMON if interface.kind != "Scheduled Execution" else _COMMON[:1]
        lacking = [prefix + n for n in needed if prefix + n not in exports]
        vital = [n for n in lacking if not n.endswith(("Terminate", "Reset"))]
        if vital:
            yield Finding(
                "fatal",
                "function-missing",
                path,
                f"{interface.kind} cannot run without {', '.join(vital)}",
                "link the library so that these are exported",
            )
        elif lacking:
            yield Finding(
                "error", "function-missing", path, f"it does not have {', '.join(lacking)}"
            )
        promised = [
            prefix + name
            for flag, functions in _PROMISED.items()
            if interface.has(flag)
            for name in functions.get(told.major, "").split()
            if prefix + name not in exports
        ]
        if promised:
            yield Finding(
                "error",
                "function-promised",
                path,
                f"{interface.kind} declares what needs {', '.join(promised)}: not in the binary",
                "it is used without",
            )
