"""Each reader takes bytes and may raise only the errors of `posmas_fmi.errors`."""

from __future__ import annotations

import gzip
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from unittest.mock import patch

import hostile
import numpy as np

from posmas_fmi import resources
from posmas_fmi.cooling.loads import read_loads
from posmas_fmi.cosim.snapshot import Snapshot
from posmas_fmi.errors import InputError, PosmasError
from posmas_fmi.expression import parse
from posmas_fmi.fmu.check.described import read_description
from posmas_fmi.fmu.check.description import description_findings
from posmas_fmi.fmu.check.finding import worst
from posmas_fmi.fmu.check.preflight import check_fmu
from posmas_fmi.fmu.check.xml import scan
from posmas_fmi.fmu.compare import read_reference
from posmas_fmi.fmu.image import ImageError, read_image
from posmas_fmi.network_file import read_adjacency
from posmas_fmi.report.json_files import design_facts, read_json, summary_facts
from posmas_fmi.scenario import load
from posmas_fmi.scenario.signals import read_signal
from posmas_fmi.scenario.tables import SignalTable


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
    with suppress(InputError):  # an empty file
        check_fmu(_file("fuzz.fmu", data), run=False)


def xml(data: bytes) -> None:
    """Read a model description."""
    if worst(scan(data, "fuzz.xml")) != "fatal":
        description_findings(read_description(data))


def signal(data: bytes) -> None:
    """Read a signal from CSV."""
    path = _file("fuzz.csv", data)
    with suppress(PosmasError):
        read_signal("s", SignalTable(file=path.name), 2, path.parent)


def netcdf(data: bytes) -> None:
    """Read a signal from NetCDF."""
    path = _file("fuzz.nc", data)
    with suppress(PosmasError), patch("posmas_fmi.netcdf.DEADLINE", 2.0):
        read_signal("s", SignalTable(file=path.name), 2, path.parent)


def loads(data: bytes) -> None:
    """Read heat loads, packed or not."""
    with suppress(PosmasError):
        read_loads(_file("loads.csv.gz", data))


def network(data: bytes) -> None:
    """Read a digraph, in each of the formats."""
    for kind in ("csv", "mtx", "graphml"):
        with suppress(PosmasError):
            read_adjacency(_file(f"fuzz.{kind}", data))


def reference(data: bytes) -> None:
    """Read a reference result."""
    with suppress(PosmasError):
        read_reference(_file("reference.csv", data))


def snapshot(data: bytes) -> None:
    """Read a snapshot of a run."""
    with suppress(PosmasError):
        Snapshot.load(_file("fuzz.npz", data))


def facts(data: bytes) -> None:
    """Read a JSON file of a run, as the report does."""
    path = _file("design.json", data)
    with suppress(PosmasError):
        content = read_json(path)
        for reader in (
            lambda: design_facts(content, {}, path),
            lambda: summary_facts(content, path),
        ):
            with suppress(PosmasError):
                reader()


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
    "signal": signal,
    "netcdf": netcdf,
    "loads": loads,
    "network": network,
    "reference": reference,
    "snapshot": snapshot,
    "facts": facts,
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
    elif reader in ("signal", "reference", "loads"):
        yield b"time,a,b\n0,1,2\n1.5,3,4e0\n"
        yield b"# band: height=1e-07, width=0\ntime,x\n0,1\n2,3\n"
        yield b"time_s,rack1_kW,wet_bulb_degC\n0,1,20\n1,2,21\n"
        yield gzip.compress(b"time_s,rack1_kW\n0,1\n1,2\n", mtime=0)
    elif reader == "network":
        yield b"from,to,weight\n1,2,1.0\n2,3,0.5\n"
        yield b"%%MatrixMarket matrix coordinate real general\n2 2 1\n1 2 1.0\n"
        yield b"%%MatrixMarket matrix array real general\n2 2\n0\n1\n1\n0\n"
        yield (
            b'<graphml xmlns="http://graphml.graphdrawing.org/xmlns"><graph edgedefault="directed">'
            b'<node id="a"/><node id="b"/><edge source="a" target="b"/></graph></graphml>'
        )
    elif reader == "netcdf":
        yield _netcdf()
        yield _older_netcdf()
    elif reader == "snapshot":
        path = _file("good.npz", b"")
        Snapshot(3, {"x": np.ones((2, 2))}, {"sent": 1}, (b"state",)).save(path)
        yield path.read_bytes()
    elif reader == "facts":
        yield b'{"method": "contraction", "K": [[1.0]], "E": [[0.5]], "certified": "yes"}'
        yield b'{"verdict": "converged", "agents": [{"name": "1", "status": "converged"}]}'
    else:
        yield next(d for n, d in hostile.corpus.entries(2).items() if n.startswith("binaries/"))


def _netcdf() -> bytes:
    import h5netcdf

    path = _file("good.nc", b"")
    with h5netcdf.File(path, "w") as file:
        file.dimensions = {"time": 2}
        for name, unit in (("time", "s"), ("load", "W")):
            variable = file.create_variable(name, ("time",), float, data=[0.0, 1.0])
            variable.attrs["units"] = unit
    return path.read_bytes()


def _older_netcdf() -> bytes:
    """As HDF5 wrote before there were checksums, so that damage comes further."""
    import h5py

    path = _file("older.nc", b"")
    with h5py.File(path, "w", libver=("earliest", "v108")) as file:
        time = file.create_dataset("time", data=[0.0, 1.0])
        time.make_scale("time")
        load = file.create_dataset("load", data=[0.0, 1.0], chunks=(2,), compression="gzip")
        load.dims[0].attach_scale(time)
        time.attrs["units"], load.attrs["units"] = "s", "W"
    return path.read_bytes()


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="posmas-fmi-fuzz-", ignore_cleanup_errors=True)


def _file(name: str, data: bytes) -> Path:
    path = Path(_folder().name, name)
    path.write_bytes(data)
    return path
