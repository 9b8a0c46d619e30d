"""Reading a .fmu file: what is unsafe or ambiguous is refused before anything is written."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from posmas_fmi.errors import ArchiveError, InputError
from posmas_fmi.fmu.check import xml
from posmas_fmi.fmu.check.finding import Finding

DESCRIPTION = "modelDescription.xml"
_READ_BY_US = (DESCRIPTION, "sources/buildDescription.xml")

MAX_ENTRIES = 20_000
MAX_SIZE = 4 * 2**30  # bytes, unpacked
MAX_RATIO = 200  # of the whole archive: deflate reaches 1032, binaries and XML 3 to 30 …
RATIO_FROM = 256 * 2**20  # … and counts from this unpacked size on
_CHUNK = 2**20
_PLAIN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+\- ]*")
_UNREADABLE = (
    zipfile.BadZipFile,
    zlib.error,
    OSError,
    EOFError,
    NotImplementedError,
    RuntimeError,  # encrypted
    ValueError,
    OverflowError,
    UnicodeDecodeError,
)


def unpack(fmu: Path, folder: Path) -> None:
    """Unpack an FMU into a folder.

    Raises
    ------
    ArchiveError
        If the file is no readable zip archive, is unsafe in any of the ways of `examine`, or has
        no model description that is plain XML.
    """
    where = str(fmu)
    for finding in examine(fmu):
        if finding.severity == "fatal":
            inside = f"{finding.place}: " if finding.place else ""
            raise ArchiveError(f"{inside}{finding.message}", where)
    try:
        with zipfile.ZipFile(fmu) as archive:
            for entry in archive.infolist():
                entry.filename = _name(entry)
                archive.extract(entry, folder)
    except _UNREADABLE as error:
        raise ArchiveError(f"expected a zip archive that can be read ({error})", where) from error


def require_file(path: Path) -> None:
    """Raise InputError if there is no file, or none with anything in it that may be read."""
    instead = _instead(path)
    if instead:
        raise InputError(f"expected an FMU ({instead})", str(path))


def _instead(path: Path) -> str:
    """Say what there is, where there is no file that can be read; empty if there is one."""
    try:
        if path.is_dir():
            return "this is a folder; zip what is in it"
        if not path.is_file():  # opening a pipe would wait for ever
            return "this is no regular file" if path.exists() else "there is no such file"
        with path.open("rb") as file:
            return "" if file.read(1) else "the file is empty; copy or export it again"
    except PermissionError:
        return "it may not be read: permission denied; 'chmod +r' lets it"
    except OSError as error:
        return f"it cannot be read: {error.strerror}"


def examine(fmu: Path, whole: bool = False) -> list[Finding]:
    """Return what is wrong with an archive; nothing is written and no code runs.

    Parameters
    ----------
    fmu : Path
    whole : bool
        Whether every entry is read to its end, so that damage shows; unpacking does that anyway.

    Returns
    -------
    list of Finding
        A fatal one stands for an archive that `unpack` refuses.
    """
    instead = _instead(fmu)
    if instead:
        return [_fatal("archive-missing", "", f"expected an FMU ({instead})")]
    try:
        with zipfile.ZipFile(fmu) as archive:
            findings = list(_entries(archive.infolist(), fmu.stat().st_size))
            if any(f.severity == "fatal" for f in findings):
                return findings
            for entry in archive.infolist():
                if _name(entry) in _READ_BY_US:
                    findings += xml.scan(archive.read(entry), _name(entry))
                elif whole:
                    findings += _damage(archive, entry)
    except _UNREADABLE as error:
        return [_damaged(str(error) or type(error).__name__, "")]
    return findings


def is_file_name(identifier: str) -> bool:
    """Whether a modelIdentifier names a file in the folder of the binaries, and nowhere else.

    Examples
    --------
    >>> [is_file_name(n) for n in ("tank", "my-model.v2", "../../tank", "")]
    [True, True, False, False]
    """
    return _PLAIN_NAME.fullmatch(identifier) is not None


def read_entry(fmu: Path, name: str, most: int | None = None) -> bytes:
    """Return an entry of an archive that `examine` found readable, or its beginning.

    Raises
    ------
    ArchiveError
    """
    try:
        with zipfile.ZipFile(fmu) as archive:
            found = [entry for entry in archive.infolist() if _name(entry) == name]
            if not found:
                raise ArchiveError(f"cannot read {name} (there is none)", str(fmu))
            with archive.open(found[-1]) as file:
                return file.read() if most is None else file.read(most)
    except _UNREADABLE as error:
        raise ArchiveError(f"cannot read {name} ({error})", str(fmu)) from error


def entry_names(fmu: Path) -> list[str]:
    """Return the names of the files in an archive that `examine` found readable."""
    with zipfile.ZipFile(fmu) as archive:
        names = [_name(entry) for entry in archive.infolist()]
    return [name for name in names if not name.endswith("/")]


def _name(entry: zipfile.ZipInfo) -> str:
    """Name of an entry; some exporters on Windows write backslashes."""
    return entry.filename.replace("\\", "/")


# ---- details ------------------------------------------------------------------------------------


def _fatal(code: str, place: str, message: str, remedy: str = "") -> Finding:
    return Finding("fatal", code, place, message, remedy)


def _damaged(said: str, place: str) -> Finding:
    return _fatal(
        "archive-damaged",
        place,
        f"expected a zip archive that can be read ({said})",
        "copy or export the file again",
    )


def _damage(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Iterator[Finding]:
    try:
        with archive.open(entry) as file:
            while file.read(_CHUNK):
                pass
    except _UNREADABLE as error:
        yield _damaged(str(error), entry.filename)


def _entries(entries: list[zipfile.ZipInfo], packed: int) -> Iterator[Finding]:
    if len(entries) > MAX_ENTRIES:
        yield _fatal(
            "archive-entries", "", f"expected at most {MAX_ENTRIES} files (got {len(entries)})"
        )
        return
    names = Counter(_name(entry) for entry in entries)
    yield from _description_place(names)
    size = sum(entry.file_size for entry in entries)
    if size > MAX_SIZE:
        yield _fatal(
            "archive-size",
            "",
            f"expected at most {MAX_SIZE // 2**30} GiB unpacked (got {size / 2**30:.3g} GiB)",
        )
    elif size > RATIO_FROM and size > MAX_RATIO * packed:
        yield _fatal(
            "archive-ratio",
            "",
            f"{packed} bytes would unpack to {size}: more than {MAX_RATIO} times as much",
        )
    if sum(entry.compress_size for entry in entries) > packed:
        yield _fatal("archive-overlap", "", "entries share the same bytes: this is a zip bomb")
    for entry in entries:
        yield from _entry(entry)
    turned = [entry.orig_filename for entry in entries if "\\" in entry.orig_filename]
    if turned:
        text = f"{len(turned)} names with backslashes: they are read as if they were slashes"
        yield Finding("warning", "archive-backslash", repr(turned[0]), text, "export it anew")
    contents: dict[str, set[tuple[int, int]]] = {}
    for entry in entries:
        contents.setdefault(_name(entry), set()).add((entry.CRC, entry.file_size))
    for name, count in names.items():
        if count == 1 or name == DESCRIPTION or name.endswith("/"):
            continue
        told = f"it is in the archive {count} times"
        if len(contents[name]) == 1 and not name.startswith("binaries/"):
            yield Finding("warning", "archive-duplicate", name, f"{told}, with the same content")
        else:
            yield _fatal("archive-duplicate", name, f"{told}: which one counts?")
    yield from _alike(names)


def _description_place(names: Counter[str]) -> Iterator[Finding]:
    count = names[DESCRIPTION]
    if count == 1:
        return
    if count:
        yield _fatal(
            "archive-duplicate",
            DESCRIPTION,
            f"expected exactly one modelDescription.xml at the top level (got {count})",
        )
        return
    deeper = [name for name in names if name.endswith("/" + DESCRIPTION)]
    yield _fatal(
        "archive-no-description",
        "",
        "expected exactly one modelDescription.xml at the top level"
        + (f" (it is {deeper[0]!r})" if deeper else " (there is none)"),
        "zip the content of the folder, not the folder itself" if deeper else "",
    )


def _entry(entry: zipfile.ZipInfo) -> Iterator[Finding]:
    name = entry.orig_filename  # zipfile hides backslashes and NUL bytes in filename
    path = PurePosixPath(_name(entry))
    if path.is_absolute() or ".." in path.parts or set(name) & {":", "\0"}:
        yield _fatal("archive-path", repr(name), "unsafe path in the archive: it may leave it")
    kind = (entry.external_attr >> 16) & 0o170000
    if kind == 0o120000:
        yield _fatal("archive-link", repr(name), "unsafe path in the archive: a symbolic link")
    elif kind not in (0, 0o100000, 0o040000):
        yield _fatal("archive-device", repr(name), "expected a file or a folder")
    if entry.flag_bits & 0x1:
        yield _fatal("archive-encrypted", repr(name), "it is encrypted", "export without password")


def _alike(names: Counter[str]) -> Iterator[Finding]:
    seen: dict[str, str] = {}
    for name in names:
        other = seen.setdefault(name.casefold(), name)
        if other != name:
            yield Finding(
                "warning",
                "archive-case",
                name,
                f"it differs from {other!r} in case only: one is lost on some systems",
            )
