"""What a shared library says about itself: ELF, PE and Mach-O headers, read without loading it."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import suppress

import attrs

_ELF_MACHINES = {3: "x86", 62: "x86_64", 40: "arm", 183: "aarch64", 243: "riscv", 21: "ppc64"}
_PE_MACHINES = {0x14C: "x86", 0x8664: "x86_64", 0xAA64: "aarch64", 0x1C0: "arm"}
_MACH_MACHINES = {
    7: "x86",
    0x0100_0007: "x86_64",
    12: "arm",
    0x0100_000C: "aarch64",
    18: "ppc",
    0x0100_0012: "ppc64",
}
_MOST_SYMBOLS = 2_000_000


class ImageError(Exception):
    """The bytes are no shared library, or one that is cut off."""


@attrs.frozen
class Image:
    """A shared library.

    Attributes
    ----------
    system : {"linux", "windows", "darwin"}
    machines : tuple of str
        Architectures, as in FMI 3 (``x86_64``); several in a universal binary of macOS.
    exports : frozenset of str or None
        Names that can be called from outside; None if this module does not read them.
    needs : tuple of str
        Other libraries that it needs.
    executable_stack : bool
        Whether it asks for a stack that code can run from, which newer systems refuse.
    """

    system: str
    machines: tuple[str, ...]
    exports: frozenset[str] | None = None
    needs: tuple[str, ...] = ()
    executable_stack: bool = False


def read_image(data: bytes) -> Image:
    """Read the headers and tables of a shared library.

    Raises
    ------
    ImageError
        If it is none, or its tables lie outside of it.

    Examples
    --------
    >>> read_image(b"MZ")
    Traceback (most recent call last):
        ...
    posmas_fmi.fmu.image.ImageError: the file is cut off or damaged
    """
    try:
        if data[:4] == b"\x7fELF":
            return _Elf(data).image()
        if data[:2] == b"MZ":
            return _pe(data)
        if len(data) >= 4 and data[:4] in _MACH_MAGIC:
            return _mach(data)
    except (struct.error, IndexError, ValueError, OverflowError) as error:
        raise ImageError("the file is cut off or damaged") from error
    raise ImageError(
        "the file is empty" if not data else "the file is no shared library (ELF, PE or Mach-O)"
    )


def _text(data: bytes, start: int) -> str:
    end = data.index(b"\0", start)
    return data[start:end].decode("utf-8", "replace")


# ---- ELF ----------------------------------------------------------------------------------------


class _Elf:
    """The dynamic tables of an ELF file, found as the loader finds them."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        if data[4] not in (1, 2) or data[5] not in (1, 2):
            raise ImageError("the file is cut off or damaged")
        self.wide = data[4] == 2
        self.order = "<" if data[5] == 1 else ">"
        self.kind, self.machine = self.read("HH", 16)
        at = (32, 54) if self.wide else (28, 42)
        (programs,) = self.read("Q" if self.wide else "I", at[0])
        size, count = self.read("HH", at[1])
        self.loads: list[tuple[int, int, int]] = []  # offset, address, size
        self.dynamic: dict[int, list[int]] = {}
        self.executable_stack = False
        table: tuple[int, int] | None = None
        for k in range(count):
            kind, flags, offset, address, length = self.program(programs + k * size)
            if kind == 1:
                self.loads.append((offset, address, length))
                if offset + length > len(data):
                    raise ImageError("the file is cut off or damaged")
            elif kind == 2:
                table = offset, length
            elif kind == 0x6474E551:
                self.executable_stack = bool(flags & 1)
        if table is not None:
            self.read_dynamic(*table)

    def read(self, layout: str, offset: int) -> tuple[int, ...]:
        return struct.unpack_from(self.order + layout, self.data, offset)

    def program(self, at: int) -> tuple[int, ...]:
        if self.wide:
            kind, flags, offset, address, _, length = self.read("IIQQQQ", at)
        else:
            kind, offset, address, _, length, _, flags = self.read("IIIIIII", at)
        return kind, flags, offset, address, length

    def read_dynamic(self, offset: int, length: int) -> None:
        word, size = ("qQ", 16) if self.wide else ("iI", 8)
        for at in range(offset, offset + length, size):
            tag, value = self.read(word, at)
            if tag == 0:
                break
            self.dynamic.setdefault(tag, []).append(value)

    def place(self, address: int) -> int:
        """Offset in the file of an address in memory."""
        for offset, start, length in self.loads:
            if start <= address < start + length:
                return address - start + offset
        raise ImageError("the file is cut off or damaged")

    def image(self) -> Image:
        if self.kind != 3:
            raise ImageError("the file is an ELF file, but no shared library")
        strings = self.dynamic.get(5)
        needs: tuple[str, ...] = ()
        exports: frozenset[str] = frozenset()
        if strings:
            base = self.place(strings[0])
            needs = tuple(_text(self.data, base + n) for n in self.dynamic.get(1, ()))
            exports = frozenset(self.exports(base))
        machine = _ELF_MACHINES.get(self.machine, f"machine {self.machine}")
        return Image("linux", (machine,), exports, needs, self.executable_stack)

    def exports(self, strings: int) -> Iterator[str]:
        if 6 not in self.dynamic:
            return
        table = self.place(self.dynamic[6][0])
        for k in range(1, min(self.count(), _MOST_SYMBOLS)):
            if self.wide:
                name, info, other, section = self.read("IBBH", table + 24 * k)
            else:
                name, _, _, info, other, section = self.read("IIIBBH", table + 16 * k)
            # defined, global or weak, visible from outside
            if section and info >> 4 in (1, 2) and other & 3 in (0, 3):
                yield _text(self.data, strings + name)

    def count(self) -> int:
        """Count the symbols: by the old hash table, else by walking the GNU one."""
        if 4 in self.dynamic:
            _, chains = self.read("II", self.place(self.dynamic[4][0]))
            return chains
        if 0x6FFFFEF5 not in self.dynamic:
            return 0
        table = self.place(self.dynamic[0x6FFFFEF5][0])
        buckets, first, bloom, _ = self.read("IIII", table)
        at = table + 16 + bloom * (8 if self.wide else 4)
        last = max(self.read(f"{buckets}I", at), default=0)
        if last < first:
            return first
        chain = at + 4 * buckets
        while not self.read("I", chain + 4 * (last - first))[0] & 1:
            last += 1
        return last + 1


# ---- PE -----------------------------------------------------------------------------------------


def _pe(data: bytes) -> Image:
    (start,) = struct.unpack_from("<I", data, 0x3C)
    if data[start : start + 4] != b"PE\0\0":
        raise ImageError("the file is cut off or damaged")
    machine, sections, _, _, _, optional, flags = struct.unpack_from("<HHIIIHH", data, start + 4)
    if not flags & 0x2000:
        raise ImageError("the file is a Windows program, but no shared library")
    (magic,) = struct.unpack_from("<H", data, start + 24)
    directories = start + 24 + (112 if magic == 0x20B else 96)
    table = start + 24 + optional
    regions = []
    for k in range(sections):
        size, address, raw, offset = struct.unpack_from("<IIII", data, table + 40 * k + 8)
        regions.append((address, max(size, raw), offset))
    exports = None
    with suppress(struct.error, ValueError):  # its tables lie outside: what it exports is unknown
        exports = frozenset(_pe_exports(data, directories, regions))
    return Image("windows", (_PE_MACHINES.get(machine, f"machine {machine:#x}"),), exports)


def _pe_exports(
    data: bytes, directories: int, regions: list[tuple[int, int, int]]
) -> Iterator[str]:
    def place(address: int) -> int:
        for start, size, offset in regions:
            if start <= address < start + size:
                return address - start + offset
        raise ValueError("outside")

    (address,) = struct.unpack_from("<I", data, directories)
    if not address:
        return
    at = place(address)
    (count,) = struct.unpack_from("<I", data, at + 24)
    (names,) = struct.unpack_from("<I", data, at + 32)
    for name in struct.unpack_from(f"<{min(count, _MOST_SYMBOLS)}I", data, place(names)):
        yield _text(data, place(name))


# ---- Mach-O -------------------------------------------------------------------------------------

_MACH_MAGIC = {
    b"\xcf\xfa\xed\xfe": "<",
    b"\xce\xfa\xed\xfe": "<",
    b"\xfe\xed\xfa\xcf": ">",
    b"\xfe\xed\xfa\xce": ">",
    b"\xca\xfe\xba\xbe": ">",
}


def _mach(data: bytes) -> Image:
    order = _MACH_MAGIC[data[:4]]
    if data[:4] == b"\xca\xfe\xba\xbe":
        (count,) = struct.unpack_from(">I", data, 4)
        if count > 16:
            raise ImageError("the file is cut off or damaged")
        kinds = [struct.unpack_from(">I", data, 8 + 20 * k)[0] for k in range(count)]
    else:
        kinds = [struct.unpack_from(order + "I", data, 4)[0]]
    return Image("darwin", tuple(_MACH_MACHINES.get(k, f"machine {k:#x}") for k in kinds))
