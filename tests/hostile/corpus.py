"""The defects: what is done to a good FMU, and what the check must find."""

from __future__ import annotations

import struct
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import attrs

from posmas_fmi import resources
from posmas_fmi.fmu.check.supervisor import Bounds
from posmas_fmi.fmu.compile import host, shared_library

HERE = Path(__file__).resolve().parent
XML = "modelDescription.xml"
BOUNDS = Bounds(call=20.0, whole=60.0, memory=2**30, output=4 * 2**20)
HANG = attrs.evolve(BOUNDS, call=1.0)
SMALL = attrs.evolve(BOUNDS, memory=300 * 2**20)

Entries = dict[str, bytes]
Change = Callable[[Entries], Entries | list[tuple[str | zipfile.ZipInfo, bytes]]]


@attrs.frozen
class Defect:
    """One defect.

    Attributes
    ----------
    name : str
        For a defect of behaviour "CALL ACTION", as in `hostile.c`.
    text : str
        What is wrong.
    severity, code : str
        The finding that names it.
    place : str
        What the place of the finding must hold.
    fmi : {2, 3}
    change : callable, optional
        What is done to the entries of the good FMU.
    damage : callable, optional
        What is done to the bytes of the file.
    bounds : Bounds
        Of the trial.
    verdict : int, optional
        The exit code, where other findings come with it that are worse.
    """

    name: str
    text: str
    severity: str
    code: str
    place: str = ""
    fmi: int = 2
    change: Change | None = None
    damage: Callable[[bytes], bytes] | None = None
    bounds: Bounds = BOUNDS
    verdict: int | None = None

    @property
    def exit_code(self) -> int:
        """Of the whole check."""
        if self.verdict is not None:
            return self.verdict
        return {"fatal": 3, "error": 1}.get(self.severity, 0)

    @property
    def runs(self) -> bool:
        """Whether it shows only when the FMU is run."""
        return self.change is None and self.damage is None


# ---- the good FMU -------------------------------------------------------------------------------

_XML2 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="hostile" guid="{{1}}" numberOfEventIndicators="0">
  <CoSimulation modelIdentifier="hostile" canHandleVariableCommunicationStepSize="true"
    canGetAndSetFMUstate="true" canSerializeFMUstate="true"/>
  <UnitDefinitions><Unit name="K"><BaseUnit K="1"/></Unit></UnitDefinitions>
  <DefaultExperiment startTime="0" stopTime="10" stepSize="0.1"/>
  <ModelVariables>
    <ScalarVariable name="u" valueReference="0" causality="input" variability="continuous">
      <Real start="0" unit="K"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="1" causality="output" variability="continuous">
      <Real unit="K"/></ScalarVariable>
    <ScalarVariable name="net" valueReference="2" causality="local" variability="continuous">
      <Real unit="K"/></ScalarVariable>
  </ModelVariables>
  <ModelStructure><Outputs><Unknown index="2"/></Outputs>
    <InitialUnknowns><Unknown index="2"/></InitialUnknowns></ModelStructure>
</fmiModelDescription>
"""
_XML3 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="hostile" instantiationToken="{{1}}">
  <CoSimulation modelIdentifier="hostile" canHandleVariableCommunicationStepSize="true"
    canGetAndSetFMUState="true" canSerializeFMUState="true"/>
  <UnitDefinitions><Unit name="K"><BaseUnit K="1"/></Unit></UnitDefinitions>
  <DefaultExperiment startTime="0" stopTime="10" stepSize="0.1"/>
  <ModelVariables>
    <Float64 name="time" valueReference="9" causality="independent" variability="continuous"/>
    <Float64 name="u" valueReference="0" causality="input" start="0" unit="K"/>
    <Float64 name="y" valueReference="1" causality="output" unit="K"/>
    <Float64 name="net" valueReference="2" causality="local" unit="K"/>
  </ModelVariables>
  <ModelStructure><Output valueReference="1"/><InitialUnknown valueReference="1"/>
  </ModelStructure>
</fmiModelDescription>
"""


@cache
def _library() -> bytes:
    headers = resources.shipped("posmas_fmi") / "fmu" / "csrc"
    files = {name: (headers / name).read_text(encoding="utf-8") for name in ("fmi2.h", "fmi3.h")}
    files["hostile.c"] = (HERE / "hostile.c").read_text(encoding="utf-8")
    flags = ("-w", "-pthread")
    return shared_library(files, ["hostile.c"], "hostile", host(), flags)


def entries(fmi: int) -> Entries:
    """Return what is in the good FMU."""
    xml = (_XML2 if fmi == 2 else _XML3).format()
    library = f"binaries/{host().folder(fmi)}/hostile{host().extension}"
    return {XML: xml.encode(), library: _library()}


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="posmas-fmi-hostile-", ignore_cleanup_errors=True)


@cache
def path(name: str) -> Path:
    """Build an FMU, once in this process.

    Parameters
    ----------
    name : str
        Of a defect; ``"good 2"`` and ``"good 3"`` have none. Any "CALL ACTION" of `hostile.c`
        will do, in FMI 2, or in FMI 3 with "3 " before it.
    """
    number = len(list(Path(_folder().name).iterdir()))
    file = Path(_folder().name, f"hostile{number}.fmu")
    defect = next((d for d in DEFECTS if d.name == name), None)
    if name.startswith("good"):
        return _written(file, entries(int(name[-1])))
    if defect is None:
        defect = Defect(name, "", "", "", fmi=3 if name.startswith("3 ") else 2)
    content = entries(defect.fmi)
    if defect.runs:
        content["resources/defect.txt"] = defect.name.removeprefix("3 ").encode()
    made = content if defect.change is None else defect.change(content)
    _written(file, made)
    if defect.damage is not None:
        file.write_bytes(defect.damage(file.read_bytes()))
    return file


def _written(file: Path, content: Entries | list[tuple[str | zipfile.ZipInfo, bytes]]) -> Path:
    import warnings

    pairs = content.items() if isinstance(content, dict) else content
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, data in pairs:
            archive.writestr(name, data)
    return file


# ---- ways to spoil it ---------------------------------------------------------------------------


def _more(*added: tuple[str | zipfile.ZipInfo, bytes]) -> Change:
    return lambda content: [*content.items(), *added]


def _kind(name: str, kind: int) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name)
    entry.external_attr = (kind | 0o644) << 16
    return entry


def _backslash(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo("x")
    entry.filename = name
    return entry


def _xml(old: str, new: str) -> Change:
    def change(content: Entries) -> Entries:
        text = content[XML].decode()
        assert old in text, old
        return {**content, XML: text.replace(old, new).encode()}

    return change


def _description(data: bytes) -> Change:
    return lambda content: {**content, XML: data}


def _binary(change: Callable[[bytes], bytes | None], rename: str = "") -> Change:
    def changed(content: Entries) -> Entries:
        made = {}
        for name, data in content.items():
            if name == XML:
                made[name] = data
                continue
            new = change(data)
            if new is not None:
                made[name.replace("hostile", rename) if rename else name] = new
        return made

    return changed


def _within(content: Entries) -> Entries:
    return {f"hostile/{name}": data for name, data in content.items()}


def _flipped(data: bytes) -> bytes:
    """Change one byte in the middle of the binary."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0xFF]) + data[middle + 1 :]


def _encrypted(data: bytes) -> bytes:
    central = data.rindex(b"PK\x01\x02")
    return data[: central + 8] + bytes([data[central + 8] | 1]) + data[central + 9 :]


def _overlapping(data: bytes) -> bytes:
    """Let an entry claim more packed bytes than the file has."""
    central = data.rindex(b"PK\x01\x02")
    return data[: central + 20] + struct.pack("<I", 2**30) + data[central + 24 :]


def _claims(data: bytes) -> bytes:
    """Let an entry claim to be huge."""
    central = data.rindex(b"PK\x01\x02")
    return data[: central + 24] + struct.pack("<I", 2**32 - 2) + data[central + 28 :]


def _hides(data: bytes) -> bytes:
    """Let the last entry claim to be small."""
    central = data.rindex(b"PK\x01\x02")
    return data[: central + 24] + struct.pack("<I", 1000) + data[central + 28 :]


def _method(data: bytes) -> bytes:
    central = data.rindex(b"PK\x01\x02")
    return data[: central + 10] + struct.pack("<H", 77) + data[central + 12 :]


def _symbol(name: str) -> Change:
    return _binary(
        lambda d: d.replace(b"\0" + name.encode() + b"\0", b"\0" + name[:-1].encode() + b"_\0")
    )


_BOMB = bytes(300 * 2**20)
_ENTITY = '<!DOCTYPE a [<!ENTITY b "x">]><a>&b;</a>'

ARCHIVE = [
    Defect("one byte", "the file holds one byte", "fatal", "archive-damaged",
           damage=lambda d: d[:1]),
    Defect("text file", "it is no archive", "fatal", "archive-damaged", damage=lambda d: b"PK?"),
    Defect("truncated", "half of the file is missing", "fatal", "archive-damaged",
           damage=lambda d: d[: len(d) // 2]),
    Defect("no end", "the end of the directory is missing", "fatal", "archive-damaged",
           damage=lambda d: d[:-30]),
    Defect("bad checksum", "one byte of the binary is changed", "fatal", "archive-damaged",
           damage=_flipped),
    Defect("encrypted", "an entry is encrypted", "fatal", "archive-encrypted", damage=_encrypted),
    Defect("unknown compression", "an entry is packed in an unknown way", "fatal",
           "archive-damaged", damage=_method),
    Defect("entries overlap", "entries claim more bytes than there are", "fatal",
           "archive-overlap", damage=_overlapping),
    Defect("claims 4 GiB", "an entry claims to be huge", "fatal", "archive-size", damage=_claims),
    Defect("bomb", "300 MiB of zeros", "fatal", "archive-ratio",
           change=lambda c: [*c.items(), ("resources/zeros", _BOMB)]),
    Defect("hidden bomb", "an entry unpacks to more than it claims", "fatal", "archive-damaged",
           change=lambda c: [*c.items(), ("resources/zeros", bytes(8 * 2**20))], damage=_hides),
    Defect("many entries", "60 000 files", "fatal", "archive-entries",
           change=lambda c: [*c.items(), *((f"resources/{k}", b"") for k in range(60_000))]),
    Defect("path up", "a name with ..", "fatal", "archive-path", change=_more(("../evil", b""))),
    Defect("path absolute", "a name that begins with /", "fatal", "archive-path",
           change=_more(("/evil", b""))),
    Defect("path drive", "a name with a drive", "fatal", "archive-path",
           change=_more(("C:/evil", b""))),
    Defect("path backslash", "a name with backslashes that leads out", "fatal", "archive-path",
           change=_more((_backslash("..\\evil"), b""))),
    Defect("path backslash inside", "a name with backslashes that stays inside", "warning",
           "archive-backslash", change=_more((_backslash("resources\\table.csv"), b""))),
    Defect("link", "a symbolic link", "fatal", "archive-link",
           change=_more((_kind("resources/link", 0o120000), b"/etc"))),
    Defect("pipe", "a named pipe", "fatal", "archive-device",
           change=_more((_kind("resources/pipe", 0o010000), b""))),
    Defect("two descriptions", "two files modelDescription.xml", "fatal", "archive-duplicate",
           change=_more((XML, b"<a/>"))),
    Defect("two of a name", "two files of one name", "fatal", "archive-duplicate",
           change=_more(("resources/a", b"1"), ("resources/a", b"2"))),
    Defect("case", "two names that differ in case only", "warning", "archive-case",
           change=_more(("resources/a", b"1"), ("resources/A", b"2"))),
    Defect("no description", "no modelDescription.xml", "fatal", "archive-no-description",
           change=lambda c: {n: d for n, d in c.items() if n != XML}),
    Defect("folder zipped", "the folder was zipped, not its content", "fatal",
           "archive-no-description", change=_within),
]  # fmt: skip

XML_DEFECTS = [
    Defect("xml empty", "the description is empty", "fatal", "xml-malformed",
           change=_description(b"")),
    Defect("xml cut", "the description ends in the middle", "fatal", "xml-malformed",
           change=lambda c: {**c, XML: c[XML][:500]}),
    Defect("xml entity", "an entity is defined", "fatal", "xml-dtd",
           change=_description(_ENTITY.encode())),
    Defect("xml file", "an entity reads a file", "fatal", "xml-dtd",
           change=_description(b'<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>')),
    Defect("xml deep", "10 000 elements inside each other", "fatal", "xml-depth",
           change=_description(b"<a>" * 10_000 + b"</a>" * 10_000)),
    Defect("xml latin-1", "it is not in UTF-8 as it says", "fatal", "xml-encoding",
           change=lambda c: {**c, XML: c[XML].replace(b"hostile", b"\xb0C", 1)}),
    Defect("xml utf-16", "it says UTF-16 and is not", "fatal", "xml-encoding",
           change=_xml('encoding="UTF-8"', 'encoding="UTF-16"')),
    Defect("xml nonsense encoding", "it says an encoding that nobody knows", "fatal",
           "xml-encoding", change=_xml('encoding="UTF-8"', 'encoding="x-nonsense"')),
    Defect("xml NUL", "it holds a NUL byte", "fatal", "xml-malformed",
           change=lambda c: {**c, XML: c[XML].replace(b"hostile", b"a\0b", 1)}),
    Defect("xml html", "it is a web page", "fatal", "description-root",
           change=_description(b"<html><body/></html>")),
]  # fmt: skip

DESCRIPTION = [
    Defect("version", "a version that there is not", "fatal", "fmi-version",
           change=_xml('fmiVersion="2.0"', 'fmiVersion="7.0"')),
    Defect("no interface", "neither Co-Simulation nor Model Exchange", "fatal", "no-interface",
           change=_xml("<CoSimulation", "<Other")),
    Defect("identifier up", "a modelIdentifier that leads out of the FMU", "fatal",
           "identifier-unsafe", change=_xml('modelIdentifier="hostile"',
                                            'modelIdentifier="../../hostile"')),
    Defect("identifier empty", "an empty modelIdentifier", "fatal", "identifier-unsafe",
           change=_xml('modelIdentifier="hostile"', 'modelIdentifier=""')),
    Defect("no guid", "no GUID", "error", "token-missing", change=_xml('guid="{1}"', "")),
    Defect("guid", "a GUID that is not that of the binary", "fatal", "no-instance", "Instantiate",
           change=_xml('guid="{1}"', 'guid="{2}"')),
    Defect("3 token", "FMI 3: an instantiationToken that is not that of the binary", "fatal",
           "no-instance", "Instantiate", fmi=3,
           change=_xml('instantiationToken="{1}"', 'instantiationToken="{2}"')),
    Defect("no variables", "no variables", "fatal", "no-variables",
           change=_xml("ModelVariables>", "Nothing>")),
    Defect("no input", "nothing to control", "warning", "no-inputs",
           change=_xml('causality="input"', 'causality="local"')),
    Defect("name twice", "two variables of one name", "error", "name-twice",
           change=_xml('name="net"', 'name="y"')),
    Defect("no name", "a variable without a name", "error", "name-missing",
           change=_xml('name="net" ', "")),
    Defect("causality", "a causality that there is not", "error", "causality",
           verdict=3, change=_xml('causality="local"', 'causality="inward"')),
    Defect("no type", "a variable without a type", "error", "type-missing",
           verdict=3, change=_xml('<Real start="0" unit="K"/>', "")),
    Defect("reference negative", "a negative value reference", "fatal", "reference",
           change=_xml('valueReference="2"', 'valueReference="-2"')),
    Defect("reference huge", "a value reference beyond 32 bits", "fatal", "reference",
           change=_xml('valueReference="2"', 'valueReference="4294967296"')),
    Defect("reference shared", "an input and an output with one value reference", "warning",
           "reference-shared", change=_xml('valueReference="1"', 'valueReference="0"')),
    Defect("start NaN", "a start value that is NaN", "error", "start-not-finite",
           change=_xml('start="0"', 'start="NaN"')),
    Defect("start text", "a start value that is no number", "error", "start-not-finite",
           verdict=3, change=_xml('start="0"', 'start="warm"')),
    Defect("start missing", "an input without a start value", "warning", "start-missing",
           change=_xml('start="0" ', "")),
    Defect("start outside", "a start value outside of its range", "warning", "start-outside",
           change=_xml('start="0"', 'start="0" min="1"')),
    Defect("range", "a range whose ends are exchanged", "warning", "range",
           change=_xml('start="0"', 'start="0" min="1" max="-1"')),
    Defect("nominal", "a nominal value of 0", "warning", "nominal",
           change=_xml('start="0"', 'start="0" nominal="0"')),
    Defect("unit", "a unit that is not defined", "warning", "unit-undefined",
           change=_xml('<Unit name="K">', '<Unit name="degC">')),
    Defect("no structure", "no ModelStructure", "warning", "structure-missing",
           change=_xml("ModelStructure>", "Nothing>")),
    Defect("structure index", "an output that there is not", "error", "structure-index",
           verdict=3, change=_xml('index="2"', 'index="9"')),
    Defect("structure output", "an output that the ModelStructure leaves out", "warning",
           "structure-output", change=_xml('<Outputs><Unknown index="2"/></Outputs>', "")),
    Defect("experiment", "an experiment that is no number", "error", "experiment",
           change=_xml('stopTime="10"', 'stopTime="soon"')),
    Defect("experiment backwards", "an experiment that ends before it begins", "warning",
           "experiment", change=_xml('stopTime="10"', 'stopTime="-10"')),
    Defect("tool", "another program is needed", "warning", "needs-tool",
           change=_xml("<CoSimulation ", '<CoSimulation needsExecutionTool="true" ')),
    Defect("not valid", "an attribute that the schema does not know", "warning", "not-valid",
           change=_xml("<CoSimulation ", '<CoSimulation colour="blue" ')),
]  # fmt: skip

BINARY = [
    Defect("no binary", "no binary for this system", "fatal", "binary-missing",
           change=_binary(lambda d: None)),
    Defect("binary name", "the library has another name", "fatal", "binary-name",
           change=_binary(lambda d: d, "other")),
    Defect("binary empty", "the library is empty", "fatal", "binary-damaged",
           change=_binary(lambda d: b"")),
    Defect("binary text", "the library is a text", "fatal", "binary-damaged",
           change=_binary(lambda d: b"hello")),
    Defect("binary cut", "half of the library is missing", "fatal", "binary-damaged",
           change=_binary(lambda d: d[: len(d) // 2])),
    Defect("binary architecture", "the library is for another processor", "fatal",
           "binary-architecture", change=_binary(lambda d: d[:18] + b"\x08\x00" + d[20:])),
    Defect("no dependency", "a library that it needs is not there", "fatal", "not-loaded", "dlopen",
           change=_binary(lambda d: d.replace(b"\0libc.so.6\0", b"\0libq.so.6\0"))),
    Defect("no doStep", "fmi2DoStep is missing", "fatal", "function-missing",
           change=_symbol("fmi2DoStep")),
    Defect("no reset", "fmi2Reset is missing", "error", "function-missing",
           change=_symbol("fmi2Reset")),
    Defect("no getFMUstate", "a promised function is missing", "error", "function-promised",
           change=_symbol("fmi2GetFMUstate")),
]  # fmt: skip

# ---- behaviour ----------------------------------------------------------------------------------

_VITAL = {
    "dlopen": "dlopen",
    "Instantiate": "Instantiate",
    "SetupExperiment": "SetupExperiment",
    "EnterInitializationMode": "EnterInitializationMode",
    "ExitInitializationMode": "ExitInitializationMode",
    "Get": "GetReal",
    "Set": "SetReal",
    "DoStep": "DoStep",
}
_OTHER = {
    "Terminate": "Terminate",
    "FreeInstance": "FreeInstance",
    "Reset": "Reset",
    "GetFMUstate": "GetFMUstate",
    "SetFMUstate": "SetFMUstate",
    "FreeFMUstate": "FreeFMUstate",
    "SerializeFMUstate": "SerializeFMUstate",
    "DeSerializeFMUstate": "DeSerializeFMUstate",
}
_CALLS = {**_VITAL, **_OTHER}
_ENDS = {
    "segv": ("writes where it must not (SIGSEGV)", "crash"),
    "fpe": ("divides by zero (SIGFPE)", "crash"),
    "overflow": ("fills the stack", "crash"),
    "abort": ("aborts (SIGABRT)", "crash"),
    "ill": ("runs an instruction that there is not (SIGILL)", "crash"),
    "kill": ("kills its process group", "crash"),
    "exit0": ("ends the process with exit(0)", "exit"),
    "exit3": ("ends the process with _exit(3)", "exit"),
}
_STATUSES = {
    "warning": ("returns Warning", "status-warning"),
    "discard": ("returns Discard", "status-discard"),
    "error": ("returns Error", "status-error"),
    "fatal": ("returns Fatal", "status-fatal"),
    "pending": ("returns Pending", "status-pending"),
    "six": ("returns 6, which is no status", "status-unknown"),
    "minus": ("returns -1, which is no status", "status-unknown"),
    "far": ("returns a huge number as status", "status-unknown"),
}


def _severity(call: str) -> str:
    return "fatal" if call in _VITAL else "error"


def _behaviour() -> list[Defect]:
    made = []
    for call, place in _CALLS.items():
        every = call in ("Instantiate", "ExitInitializationMode", "DoStep", "FreeInstance")
        for action, (text, code) in _ENDS.items():
            if action in ("segv", "exit0") or every:
                made.append(Defect(f"{call} {action}", f"{place} {text}", _severity(call), code,
                                   place))  # fmt: skip
        made.append(
            Defect(
                f"{call} hang",
                f"{place} does not come back",
                _severity(call),
                "hang",
                place,
                bounds=HANG,
            )
        )
        if call in ("dlopen", "Instantiate", "FreeInstance"):
            continue  # they return no status
        for action, (text, code) in _STATUSES.items():
            if action == "error" or call in ("ExitInitializationMode", "DoStep"):
                severity = "warning" if action == "warning" else _severity(call)
                made.append(Defect(f"{call} {action}", f"{place} {text}", severity, code, place))
    return made


def _late(name: str, text: str, code: str, place: str, **more: object) -> Defect:
    return Defect(name, text, "error", code, place, **more)  # type: ignore[arg-type]


def _odd(name: str, text: str, code: str, place: str = "", **more: object) -> Defect:
    return Defect(name, text, "warning", code, place, **more)  # type: ignore[arg-type]


LIFE = [
    *_behaviour(),
    _late("dlclose segv", "it crashes when it is unloaded", "crash", "dlclose"),
    _late("DoStep segv 9", "the 9th step crashes", "crash", "DoStep"),
    _late("DoStep error 9", "the 9th step returns Error", "status-error", "DoStep"),
    _late("DoStep hang 9", "the 9th step does not come back", "hang", "DoStep", bounds=HANG),
    Defect("DoStep spin", "a step computes for ever", "fatal", "hang", "DoStep", bounds=HANG),
    Defect("DoStep stop", "a step stops its process", "fatal", "hang", "DoStep", bounds=HANG),
    _late("DoStep slow", "each step takes 0.4 s, together more than the trial may", "too-slow", "",
          bounds=attrs.evolve(BOUNDS, whole=3.0)),
    Defect("Instantiate null", "it returns no instance", "fatal", "no-instance", "Instantiate"),
    _late("Instantiate same", "it returns the same instance twice", "instances-share", ""),
    _late("DoStep shared", "instances share a variable", "instances-share", "DoStep"),
    _odd("DoStep random", "a step depends on earlier instances", "not-repeatable", "DoStep",
         verdict=1),
    _late("Reset nothing", "a reset does nothing", "reset-differs", "Reset"),
    _late("SetFMUstate nothing", "a saved state is not restored", "rollback-differs",
          "SetFMUState"),
    _odd("SetFMUstate noise", "a saved state is restored to 5 digits", "rollback-noise",
         "SetFMUState"),
    _late("DeSerializeFMUstate zero", "a serialised state loses a value", "serialise-differs", ""),
    _late("Get nan", "outputs are NaN", "not-finite", "y"),
    _late("Get inf", "outputs are infinite", "not-finite", "y"),
    _odd("Get absurd", "outputs are 1e300", "absurd", "y"),
    Defect("FreeInstance twice", "it frees memory twice", "error", "crash", "FreeInstance"),
    Defect("DoStep memory", "it takes all memory", "fatal", "memory-limit", "DoStep", bounds=SMALL),
    Defect("DoStep flood", "it writes to stdout for ever", "fatal", "output-limit", "DoStep"),
    _odd("DoStep leak", "each step leaves 64 KiB behind", "leak", "DoStep"),
    _odd("FreeInstance keeps", "each instance leaves 1 MiB behind", "leak", "FreeInstance"),
    _odd("DoStep thread", "a thread goes on after the end", "leaves-threads", ""),
    Defect("DoStep opens", "it opens files for ever", "fatal", "handles-limit", "DoStep"),
    Defect("DoStep fills", "it fills the folder for temporary files", "fatal", "files-limit",
           "DoStep", bounds=attrs.evolve(BOUNDS, files=64 * 2**20)),
    _odd("DoStep child 20", "a process that it started goes on", "leaves-processes"),
    _odd("DoStep daemon 20", "one in a session of its own goes on", "leaves-processes"),
    _odd("DoStep open", "files stay open after the end", "leaves-descriptors", ""),
    _odd("DoStep log-null", "it logs a NULL message", "log-null", "DoStep"),
    _odd("DoStep log-category", "it logs a NULL category", "log-null", "DoStep"),
    _odd("DoStep log-utf8", "it logs what is not UTF-8", "log-utf8", "DoStep"),
    _odd("DoStep log-format", "it logs a dangerous format", "log-format", "DoStep"),
    _odd("DoStep log-status", "it logs a status that there is not", "log-status", "DoStep"),
    _odd("DoStep log-environment", "it logs with a wrong pointer", "log-environment", "DoStep"),
    _odd("DoStep log-large", "it logs 8 MiB at once", "log-large", "DoStep"),
    _odd("DoStep log-thread", "it logs from another thread", "log-thread", "DoStep"),
    Defect("DoStep log-endless", "it logs for ever", "fatal", "log-endless", "DoStep"),
    _odd("DoStep folder", "it changes the working directory", "changes-folder", "DoStep"),
    _odd("DoStep locale", "it changes the locale", "changes-locale", "DoStep"),
    _odd("DoStep environment", "it sets an environment variable", "changes-environment", "DoStep"),
    _odd("DoStep rounding", "it rounds floats upwards", "changes-rounding", "DoStep"),
    _odd("DoStep denormals", "it flushes small floats to zero", "changes-denormals", "DoStep"),
    _odd("DoStep traps", "it lets 0/0 end the process", "changes-traps", "DoStep"),
    _odd("DoStep signals", "it ignores Ctrl-C", "changes-signals", "DoStep"),
    _odd("dlopen handler", "it takes a signal when it is loaded", "changes-signals", "dlopen"),
    _odd("DoStep close", "it closes all files", "closes-descriptors", "DoStep"),
    Defect("3 DoStep segv", "FMI 3: a step crashes", "fatal", "crash", "DoStep", fmi=3),
    Defect("3 DoStep hang", "FMI 3: a step does not come back", "fatal", "hang", "DoStep", fmi=3,
           bounds=HANG),
    Defect("3 DoStep exit0", "FMI 3: a step ends the process", "fatal", "exit", "DoStep", fmi=3),
    Defect("3 DoStep six", "FMI 3: a step returns 6", "fatal", "status-unknown", "DoStep", fmi=3),
    Defect("3 DoStep discard", "FMI 3: a step returns Discard", "fatal", "status-discard",
           "DoStep", fmi=3),
    Defect("3 DoStep stuck", "FMI 3: a step returns early for ever", "fatal", "stuck", "DoStep",
           fmi=3),
    Defect("3 DoStep terminates", "FMI 3: it asks to end at once", "fatal", "terminates",
           "DoStep", fmi=3),
    Defect("3 Get nan", "FMI 3: outputs are NaN", "error", "not-finite", "y", fmi=3),
    _odd("3 DoStep log-null", "FMI 3: it logs a NULL message", "log-null", "DoStep", fmi=3),
    Defect("3 Instantiate null", "FMI 3: it returns no instance", "fatal", "no-instance",
           "Instantiate", fmi=3),
    _late("3 Reset nothing", "FMI 3: a reset does nothing", "reset-differs", "Reset", fmi=3),
    _late("3 SetFMUstate nothing", "FMI 3: a saved state is not restored", "rollback-differs",
          "SetFMUState", fmi=3),
]  # fmt: skip

GROUPS = {
    "The archive": ARCHIVE,
    "The XML": XML_DEFECTS,
    "The description": DESCRIPTION,
    "The binary": BINARY,
    "Behaviour": LIFE,
}
DEFECTS = [defect for group in GROUPS.values() for defect in group]
