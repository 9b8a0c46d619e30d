"""Readers of what strangers wrote end with typed errors only, whatever the bytes are."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from fuzz.readers import READERS, beginnings
from hypothesis import given, settings
from hypothesis import strategies as st

from posmas_fmi.cooling.loads import read_loads
from posmas_fmi.cosim.snapshot import Snapshot
from posmas_fmi.errors import InputError, NetworkError
from posmas_fmi.network_file import read_adjacency
from posmas_fmi.report.json_files import read_json
from posmas_fmi.scenario import load

WORDS = [
    *("x1", "x2", "t", "u1", "x9", "sin", "exp", "sqrt", "log", "min", "clip", "abs", "sign"),
    *("+", "-", "*", "/", "**", "(", ")", ",", "<", "if", "else", "0", "1e308", "1e999", "0.1"),
    *("9" * 30, "lambda", "__import__", "'", '"', ".", "[", "]", "=", "\n", " ", "\0", "é"),
]
VALUES = [
    *("0", "-1", "1e308", "nan", "inf", "-inf", "true", '""', '"x"', "[]", "[[]]", "{}", "1e-300"),
    *("9999999999999999999", "2024-01-01", '"../../etc/passwd"', "[1, 'a']", "[nan]", "[[1.0]]"),
]

EXAMPLES = {"netcdf": 12}  # each starts a process


@st.composite
def spoiled(draw: Callable, reader: str) -> bytes:
    """Good bytes with some parts replaced, removed or doubled."""
    data = draw(st.sampled_from(beginnings(reader)))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        end = min(len(data), at + draw(st.sampled_from([0, 1, 1, 2, 4, 8, 100])))
        new = draw(st.one_of(st.binary(max_size=8), st.just(data[at:end] * 2)))
        data = data[:at] + new + data[end:]
    return data


@st.composite
def other_values(draw: Callable) -> bytes:
    """A scenario with other values, lines left out, lines twice."""
    lines = draw(st.sampled_from(beginnings("scenario"))).decode().splitlines()
    for _ in range(draw(st.integers(1, 3))):
        k = draw(st.integers(0, len(lines) - 1))
        key, equals, _ = lines[k].partition("=")
        kind = draw(st.sampled_from(["value", "value", "value", "without", "twice"]))
        if kind == "value" and equals:
            lines[k] = f"{key}= {draw(st.sampled_from(VALUES))}"
        elif kind == "without":
            lines[k] = ""
        elif kind == "twice":
            lines.insert(k, lines[k])
    return "\n".join(lines).encode()


@pytest.mark.parametrize("reader", READERS)
def test_the_beginnings_are_read(reader: str) -> None:
    assert beginnings(reader)
    for data in beginnings(reader):
        READERS[reader](data)


@pytest.mark.parametrize("reader", READERS)
def test_spoiled_bytes(reader: str) -> None:
    @settings(max_examples=EXAMPLES.get(reader, 60))
    @given(data=spoiled(reader))
    def read(data: bytes) -> None:
        READERS[reader](data)

    read()


@settings(max_examples=100)
@given(words=st.lists(st.sampled_from(WORDS), max_size=12))
def test_expressions_of_any_words(words: list[str]) -> None:
    READERS["expression"]("".join(words).encode())


def test_a_run_that_would_never_end_is_refused() -> None:
    """Found by fuzzing: it ended with an OverflowError."""
    good = beginnings("scenario")[0]
    READERS["scenario"](good.replace(b"until = 10.0", b"until = 1e308"))
    READERS["scenario"](good.replace(b"period = 0.005", b"period = 1e308"))


TOO_LARGE = {
    "agents": ("agents = 4", "agents = 1000000000", "at most 1000000 agents"),
    "digits": ("seed = 1", "seed = " + "9" * 5000, "not TOML"),
    "long key": ("phi = 10.0", "phi" + ".a" * 20_000 + " = 1", "nested too deeply"),
    "key in keys": ("phi = 10.0", "phi = " + "{a.b.c = " * 40 + "1" + "}" * 40, "too deeply"),
    "arrays": ("phi = 10.0", "phi = " + "[" * 300 + "]" * 300, "nested too deeply"),
    "power of a sum": ("x1*sin(0.31*x1*t)", "((x1 + x2 + 1)**64)**64", "more than 5000 terms"),
    "product of sums": ("x1*sin(0.31*x1*t)", "(x1 + x2)*(x1 + t)**60*(x2 + t)**60*t", "5000 terms"),
    "choices": (
        "x1*sin(0.31*x1*t)",
        "min(" + ", ".join(f"x1 + {k}*x2" for k in range(40)) + ")",
        "at most 20 arguments",
    ),
}


@pytest.mark.parametrize("name", TOO_LARGE)
def test_small_scenarios_of_much_work_are_refused(name: str, tmp_path: Path) -> None:
    """Each took minutes, gigabytes or ended with a traceback."""
    good, bad, message = TOO_LARGE[name]
    text = beginnings("scenario")[0].decode()
    assert good in text
    path = tmp_path / "large.toml"
    path.write_text(text.replace(good, bad))
    with pytest.raises(InputError, match=message):
        load(path)


NETWORKS = {
    "far.csv": "from,to\n1,2\n2,99999999999\n",
    "far.mtx": "%%MatrixMarket matrix coordinate real general\n3000000000 3000000000 1\n1 2 1.0\n",
    "short.mtx": "%%MatrixMarket matrix array real general\n900000 900000\n1.0\n",
    "none.mtx": "%%MatrixMarket matrix coordinate real general\n9 9 2\n1 2 1.0\n",
    "few.mtx": "%%MatrixMarket matrix coordinate real general\n9 9 999999999999\n1 2 1.0\n",
}


@pytest.mark.parametrize("name", NETWORKS)
def test_small_files_of_huge_networks_are_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(NETWORKS[name])
    with pytest.raises(NetworkError, match=r"at most 1000000 agents|fewer numbers than it says"):
        read_adjacency(path)


def test_facts_of_a_snapshot_that_are_none(tmp_path: Path) -> None:
    """They ended with a KeyError."""
    for text in (b"{}", b"[]", b'{"k": "x", "counts": 3, "serialised": 1}'):
        np.savez(tmp_path / "s.npz", facts=np.frombuffer(text, dtype=np.uint8))
        with pytest.raises(InputError, match="not a snapshot"):
            Snapshot.load(tmp_path / "s.npz")


@pytest.mark.parametrize("depth", [300, 600, 900, 100_000])
def test_json_that_is_too_deep(tmp_path: Path, depth: int) -> None:
    path = tmp_path / "design.json"
    path.write_text('{"a": ' + "[" * depth + "]" * depth + "}")
    with suppress(InputError):
        read_json(path)


def test_packed_loads_that_are_damaged_or_huge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "loads.csv.gz"
    whole = gzip.compress(b"time_s,rack1_kW\n" + b"0,1\n" * 1000, mtime=0)
    path.write_bytes(whole[:14] + b"\xff\xff\xff" + whole[17:])
    with pytest.raises(InputError, match="expected a CSV file"):
        read_loads(path)
    monkeypatch.setattr("posmas_fmi.cooling.loads._LARGEST_FILE", 1000)
    path.write_bytes(whole)
    with pytest.raises(InputError, match="larger than 1000 bytes"):
        read_loads(path)


@settings(max_examples=100)
@given(data=other_values())
def test_scenarios_with_any_values(data: bytes) -> None:
    READERS["scenario"](data)
