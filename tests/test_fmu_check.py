"""Preflight without running: each defect of archive, XML, description and binary has its code."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import attrs
import hostile
import pytest
from fmu_examples import tank_fmu

from posmas_fmi.errors import ArchiveError
from posmas_fmi.fmu import archive
from posmas_fmi.fmu.archive import examine, read_entry, unpack
from posmas_fmi.fmu.check.binaries import binary_findings, read_binaries
from posmas_fmi.fmu.check.described import read_description
from posmas_fmi.fmu.check.description import description_findings, strict_findings
from posmas_fmi.fmu.check.finding import worst
from posmas_fmi.fmu.check.preflight import check_fmu
from posmas_fmi.fmu.check.xml import MAX_DEPTH, scan
from posmas_fmi.fmu.compile import host
from posmas_fmi.fmu.image import ImageError, read_image

Entry = tuple[zipfile.ZipInfo | str, bytes]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tank_fmu(tmp_path_factory.mktemp("check"), 2)


def codes(findings: list) -> set[str]:
    return {f.code for f in findings if f.severity in ("error", "fatal", "warning")}


def entries(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def packed(to: Path, content: list[Entry]) -> Path:
    with zipfile.ZipFile(to, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in content:
            file.writestr(name, data)
    return to


def test_a_good_fmu_has_no_findings_that_matter(good: Path) -> None:
    told = read_description(read_entry(good, "modelDescription.xml"))
    found = examine(good, whole=True) + description_findings(told)
    found += binary_findings(good, told, read_binaries(good)) + strict_findings(good, told)
    assert worst(found) in (None, "note")


# ---- archive ------------------------------------------------------------------------------------


def special(name: str, kind: int) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name)
    entry.external_attr = (kind | 0o644) << 16
    return entry


@pytest.mark.parametrize(
    ("more", "code"),
    [
        (("../evil", b""), "archive-path"),
        (("/evil", b""), "archive-path"),
        (("C:/evil", b""), "archive-path"),
        (("a\\..\\evil", b""), "archive-path"),
        ((special("link", 0o120000), b"/"), "archive-link"),
        ((special("pipe", 0o010000), b""), "archive-device"),
        (("ModelDescription.xml", b""), "archive-case"),
    ],
)
def test_entries_that_are_not_safe(good: Path, tmp_path: Path, more: Entry, code: str) -> None:
    path = packed(tmp_path / "bad.fmu", [*entries(good).items(), more])
    assert code in codes(examine(path))


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("name", ["modelDescription.xml", "resources/a.txt"])
def test_names_that_are_there_twice(good: Path, tmp_path: Path, name: str) -> None:
    content: list[Entry] = [*entries(good).items(), (name, b"1"), (name, b"2")]
    path = packed(tmp_path / "bad.fmu", content)
    assert codes(examine(path)) == {"archive-duplicate"}
    with pytest.raises(ArchiveError):
        unpack(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("limit", "value", "code"),
    [
        ("MAX_ENTRIES", 1, "archive-entries"),
        ("MAX_SIZE", 100, "archive-size"),
        ("RATIO_FROM", 1000, "archive-ratio"),
    ],
)
def test_archives_that_are_too_large(
    good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, value: int, code: str
) -> None:
    bomb = [*entries(good).items(), ("resources/zeros", bytes(50_000_000))]
    path = packed(tmp_path / "bomb.fmu", bomb)
    assert codes(examine(path)) == set()
    monkeypatch.setattr(archive, limit, value)
    assert codes(examine(path)) == {code}


def test_a_folder_that_was_zipped_as_a_whole(good: Path, tmp_path: Path) -> None:
    path = packed(tmp_path / "bad.fmu", [(f"tank/{n}", d) for n, d in entries(good).items()])
    (finding,) = examine(path)
    assert finding.code == "archive-no-description"
    assert "content of the folder" in finding.remedy


def test_damage_and_encryption(good: Path, tmp_path: Path) -> None:
    data = good.read_bytes()
    with zipfile.ZipFile(good) as file:
        entry = next(e for e in file.infolist() if e.filename.startswith("binaries/"))
    middle = entry.header_offset + 60 + entry.compress_size // 2
    bad = tmp_path / "bad.fmu"
    bad.write_bytes(data[:middle] + bytes([data[middle] ^ 0xFF]) + data[middle + 1 :])
    assert codes(examine(bad)) == set()  # shows only to those who read all of it
    assert codes(examine(bad, whole=True)) == {"archive-damaged"}
    bad.write_bytes(data[: len(data) // 2])
    assert codes(examine(bad)) == {"archive-damaged"}
    central = data.rindex(b"PK\x01\x02")
    bad.write_bytes(data[: central + 8] + bytes([data[central + 8] | 1]) + data[central + 9 :])
    assert codes(examine(bad)) == {"archive-encrypted"}


# ---- XML ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b'<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', "xml-dtd"),
        (b'<!DOCTYPE a [<!ENTITY b "x">]><a>&b;</a>', "xml-dtd"),
        (b"<a>" * (MAX_DEPTH + 1) + b"</a>" * (MAX_DEPTH + 1), "xml-depth"),
        (b"<a><b></a>", "xml-malformed"),
        (b"", "xml-malformed"),
        (b"<a:b/>", "xml-malformed"),
        ('<a b="°C"/>'.encode("latin-1"), "xml-encoding"),
        (b'<?xml version="1.0" encoding="UTF-16"?><a/>', "xml-encoding"),
        (b'<?xml version="1.0" encoding="x-nonsense"?><a/>', "xml-encoding"),
    ],
)
def test_xml_that_is_not_plain(good: Path, tmp_path: Path, data: bytes, code: str) -> None:
    assert [(f.severity, f.code) for f in scan(data, "a.xml")] == [("fatal", code)]
    content = {**entries(good), "modelDescription.xml": data}
    path = packed(tmp_path / "bad.fmu", [*content.items()])
    with pytest.raises(ArchiveError):
        unpack(path, tmp_path / "out")


# ---- description --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        (b"fmiModelDescription", b"html", "description-root"),
        (b'fmiVersion="2.0"', b'fmiVersion="7.0"', "fmi-version"),
        (b"CoSimulation", b"Nothing", "no-co-simulation"),
        (b'modelIdentifier="tank"', b'modelIdentifier="../../tank"', "identifier-unsafe"),
        (b'modelIdentifier="tank"', b'modelIdentifier="my-tank"', "identifier"),
        (b'guid="', b'other="', "token-missing"),
        (b'name="net"', b'name="power"', "name-twice"),
        (b'causality="input"', b'causality="outside"', "causality"),
        (b'causality="input"', b'causality="local"', "no-inputs"),
        (b'start="100.0"', b'start="many"', "start-not-finite"),
        (b'start="100.0"', b'start="NaN"', "start-not-finite"),
        (b'start="100.0"', b'start="5" min="6" max="7"', "start-outside"),
        (b'start="100.0"', b'min="7" max="6"', "range"),
        (b' start="100.0"', b"", "start-missing"),
        (b'valueReference="1"', b'valueReference="-1"', "reference"),
        (b'nominal="300.0"', b'nominal="0"', "nominal"),
        (b'unit="W"', b'unit="horse"', "unit-undefined"),
        (b'stopTime="100', b'stopTime="-100', "experiment"),
        (b'stopTime="100', b'stopTime="x', "experiment"),
        (b"<CoSimulation ", b'<CoSimulation needsExecutionTool="true" ', "needs-tool"),
    ],
)
def test_descriptions_with_one_mistake(good: Path, old: bytes, new: bytes, code: str) -> None:
    data = read_entry(good, "modelDescription.xml")
    assert old in data
    assert code in codes(description_findings(read_description(data.replace(old, new))))


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_outputs_of_a_structure_are_looked_up_not_searched_for(
    fmi: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An FMU with 200 000 outputs had not been read after seven minutes."""
    compared = 0

    def counted(kind: type) -> type:
        def equal(self: object, other: object) -> bool:
            nonlocal compared
            compared += 1
            return bool(kind.__eq__(self, other))

        return type("Counted", (kind,), {"__eq__": equal, "__hash__": kind.__hash__})

    told = read_description(hostile.corpus.entries(fmi)[hostile.corpus.XML])
    (output,) = [v for v in told.variables if v.causality == "output"]
    many = [attrs.evolve(output, name=f"y{k}", reference=str(k)) for k in range(100, 300)]
    texts = [str(k + 1) for k in range(200)] if fmi == 2 else [v.reference for v in many]
    whole = attrs.evolve(told, variables=tuple(many), outputs=tuple(map(counted(str), texts)))
    monkeypatch.setattr("posmas_fmi.fmu.check.description.int", counted(int), raising=False)
    assert not {"structure-index", "structure-output"} & codes(description_findings(whole))
    assert compared < 10 * len(many)


def test_strict_validation_is_never_fatal(good: Path, tmp_path: Path) -> None:
    content = entries(good)
    data = content["modelDescription.xml"]
    content["modelDescription.xml"] = data.replace(b'causality="input"', b'causality="inward"')
    path = packed(tmp_path / "bad.fmu", [*content.items()])
    (finding,) = strict_findings(path, read_description(content["modelDescription.xml"]))
    assert (finding.severity, finding.code) == ("warning", "not-valid")


# ---- binaries -----------------------------------------------------------------------------------


def with_binary(
    good: Path, to: Path, change: Callable[[str, bytes], tuple[str, bytes] | None]
) -> set[str]:
    content: list[Entry] = []
    for name, data in entries(good).items():
        new = change(name, data) if name.startswith("binaries/") else (name, data)
        content += [new] if new else []
    path = packed(to, content)
    told = read_description(read_entry(path, "modelDescription.xml"))
    return codes(binary_findings(path, told, read_binaries(path)))


@pytest.mark.skipif(host().extension != ".so", reason="patches an ELF file")
@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda n, d: None, "binary-missing"),
        (lambda n, d: (n.replace("tank.so", "other.so"), d), "binary-name"),
        (lambda n, d: (n, b""), "binary-damaged"),
        (lambda n, d: (n, b"hello"), "binary-damaged"),
        (lambda n, d: (n, d[: len(d) // 2]), "binary-damaged"),
        (lambda n, d: (n, d[:18] + b"\x08\x00" + d[20:]), "binary-architecture"),
        (lambda n, d: (n, d.replace(b"\0fmi2DoStep\0", b"\0fmi2DoStop\0")), "function-missing"),
        (lambda n, d: (n, d.replace(b"\0fmi2Reset\0", b"\0fmi2Resat\0")), "function-missing"),
        (
            lambda n, d: (n, d.replace(b"\0fmi2GetFMUstate\0", b"\0fmi2GotFMUstate\0")),
            "function-promised",
        ),
    ],
)
def test_binaries_with_one_defect(
    good: Path, tmp_path: Path, change: Callable[[str, bytes], tuple[str, bytes] | None], code: str
) -> None:
    assert code in with_binary(good, tmp_path / "bad.fmu", change)


@pytest.mark.parametrize("size", [0, 2, 5, 20, 64, 200, 1000])
def test_any_beginning_of_a_library_is_read_or_refused(good: Path, size: int) -> None:
    name = next(n for n in entries(good) if n.startswith("binaries/"))
    with pytest.raises(ImageError):
        read_image(entries(good)[name][:size])


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_what_is_there_twice_with_the_same_content(good: Path, tmp_path: Path) -> None:
    """Roberts of the Reference FMUs lists a folder and a file twice: nothing is ambiguous."""
    twice: list[Entry] = [("extra/", b""), ("extra/a.xml", b"<a/>")]
    path = packed(tmp_path / "twice.fmu", [*entries(good).items(), *twice, *twice])
    findings = examine(path)
    assert [(f.severity, f.place) for f in findings] == [("warning", "extra/a.xml")]
    unpack(path, tmp_path / "out")
    assert (tmp_path / "out" / "extra" / "a.xml").read_bytes() == b"<a/>"


def test_a_description_that_breaks_a_rule_is_reported_and_used(tmp_path: Path) -> None:
    """FMPy refuses both mistakes, also where it does not validate; real FMUs have them."""
    content = hostile.corpus.entries(2)
    good = content[hostile.corpus.XML].decode()
    plain = 'causality="local" variability="continuous">\n      <Real unit="K"/>'
    odd = 'causality="parameter" variability="constant">\n      <Real declaredType="T" start="0"/>'
    assert plain in good
    path = tmp_path / "odd.fmu"
    content[hostile.corpus.XML] = good.replace(plain, odd).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    made = check_fmu(path, control=False)
    assert "not-valid" in [finding.code for finding in made.findings]
    assert made.results["steps"] > 10
    assert made.exit_code == 0
