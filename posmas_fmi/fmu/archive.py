"""Unpacking a .fmu file: only what is safe to write below the folder given."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path, PurePosixPath

from posmas_fmi.errors import ArchiveError

MAX_ENTRIES = 20_000
MAX_SIZE = 4 * 2**30  # bytes, unpacked


def unpack(fmu: Path, folder: Path) -> None:
    """Unpack an FMU into a folder.

    Raises
    ------
    ArchiveError
        If the file is no readable zip archive, has no model description, is too large, or holds a
        path that leaves the folder.
    """
    where = str(fmu)
    if not fmu.is_file():
        raise ArchiveError("expected an FMU (there is no such file)", where)
    try:
        with zipfile.ZipFile(fmu) as archive:
            entries = archive.infolist()
            _check(entries, where)
            for entry in entries:
                archive.extract(entry, folder)
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, NotImplementedError) as error:
        raise ArchiveError(f"expected a zip archive that can be read ({error})", where) from error
    except RuntimeError as error:  # zipfile's error for encrypted entries
        raise ArchiveError(f"cannot be unpacked: {error}", where) from error


def _check(entries: list[zipfile.ZipInfo], where: str) -> None:
    names = [entry.filename for entry in entries]
    if names.count("modelDescription.xml") != 1:
        raise ArchiveError("expected exactly one modelDescription.xml at the top level", where)
    if len(entries) > MAX_ENTRIES or sum(entry.file_size for entry in entries) > MAX_SIZE:
        raise ArchiveError(
            f"expected at most {MAX_ENTRIES} files and {MAX_SIZE // 2**30} GiB unpacked", where
        )
    for entry in entries:
        path = PurePosixPath(entry.filename)
        symlink = (entry.external_attr >> 16) & 0o170000 == 0o120000
        # orig_filename: zipfile hides backslashes and NUL bytes in filename
        bad = set(entry.orig_filename) & {"\\", ":", "\0"}
        if path.is_absolute() or ".." in path.parts or bad or symlink:
            raise ArchiveError(f"unsafe path in the archive: {entry.orig_filename!r}", where)
