"""Each reader takes bytes and may raise only the errors of `posmas_fmi.errors`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

import hostile

from posmas_fmi import resources
from posmas_fmi.errors import PosmasError
from posmas_fmi.expression import parse
from posmas_fmi.fmu.check.described import read_description
from posmas_fmi.fmu.check.description import description_findings
from posmas_fmi.fmu.check.finding import worst
from posmas_fmi.fmu.check.image import ImageError, read_image
from posmas_fmi.fmu.check.preflight import check_fmu
from posmas_fmi.fmu.check.xml import scan
from posmas_fmi.scenario import load


def expression(data: bytes) -> None:
    """Read an expression of a scenario."""
    with suppress(PosmasError):
        parse(data.decode("utf-8", "replace"), ["t", "x1", "x2", "u1"])


def scenario(data: bytes) -> None:
    """Read a scenario file."""
    path = _file("fuzz.toml", data)
    with suppress(PosmasError):
        load(path)


def archive(data: bytes) -> None:
    """Examine an FMU without running it."""
    check_fmu(_file("fuzz.fmu", data), run=False)


def xml(data: bytes) -> None:
    """Read a model description."""
    if worst(scan(data, "fuzz.xml")) != "fatal":
        description_findings(read_description(data))


def image(data: bytes) -> None:
    """Read the tables of a shared library."""
    with suppress(ImageError):
        read_image(data)


READERS: dict[str, Callable[[bytes], None]] = {
    "expression": expression,
    "scenario": scenario,
    "archive": archive,
    "xml": xml,
    "image": image,
}


@cache
def beginnings(reader: str) -> tuple[bytes, ...]:
    """Return bytes that a reader takes."""
    return tuple(_beginnings(reader))


def _beginnings(reader: str) -> Iterator[bytes]:
    if reader == "expression":
        texts = [
            "x1*sin(0.31*x1*t)",
            "1.2*u1 - 0.3*u1*abs(sin(u1))",
            "clip(u1, -1, 1) + min(x1, 2)",
        ]
        yield from (text.encode() for text in texts)
        yield b"exp(-x1)**2 / sqrt(1 + x2**2) if 0 else tanh(1e-3)"
    elif reader == "scenario":
        for name in ("paper_example_1", "paper_example_1_tanh"):
            yield (resources.shipped("models") / f"{name}.toml").read_bytes()
    elif reader == "archive":
        yield hostile.path("good 2").read_bytes()
        yield hostile.path("xml entity").read_bytes()
    elif reader == "xml":
        for fmi in (2, 3):
            yield hostile.corpus.entries(fmi)[hostile.corpus.XML]
    else:
        yield next(d for n, d in hostile.corpus.entries(2).items() if n.startswith("binaries/"))


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="posmas-fmi-fuzz-", ignore_cleanup_errors=True)


def _file(name: str, data: bytes) -> Path:
    path = Path(_folder().name, name)
    path.write_bytes(data)
    return path
