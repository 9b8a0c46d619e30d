"""Digraphs from files: CSV, Matrix Market and GraphML."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from posmas_fmi.bounded import require_regular
from posmas_fmi.errors import NetworkError
from posmas_fmi.network import check_size

LARGEST_FILE = 1_000_000_000  # bytes


def read_adjacency(path: Path) -> tuple[sp.csr_array, tuple[str, ...]]:
    """Read a digraph from ``.csv`` (header ``from,to[,weight]``), ``.mtx`` or ``.graphml``.

    Parameters
    ----------
    path : Path
        In Matrix Market files row i lists whom agent i hears.

    Returns
    -------
    adjacency : (N, N) sparse array
    names : tuple of str
        Node names, in the order of the rows.

    Raises
    ------
    NetworkError
        If the file cannot be read as a digraph.
    """
    readers = {".csv": _read_csv, ".mtx": _read_matrix_market, ".graphml": _read_graphml}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise NetworkError(
            f"expected a .csv, .mtx or .graphml file (got {path.name})", "$.network.file"
        )
    try:
        require_regular(path)
        if path.stat().st_size > LARGEST_FILE:
            raise NetworkError(
                f"{path.name} is larger than {LARGEST_FILE:g} bytes", "$.network.file"
            )
        return reader(path)
    except NetworkError:
        raise
    except Exception as error:  # whatever a foreign parser raises on a broken file
        raise NetworkError(f"cannot read {path.name}: {error}", "$.network.file") from error


def _read_csv(path: Path) -> tuple[sp.csr_array, tuple[str, ...]]:
    with path.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.reader(stream))
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    if header not in (["from", "to"], ["from", "to", "weight"]):
        raise NetworkError(
            f"{path.name}, line 1: expected the header from,to or from,to,weight (got {header})",
            "$.network.file",
        )
    arcs: list[tuple[str, str, float]] = []
    for number, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        if len(row) != len(header):
            raise NetworkError(
                f"{path.name}, line {number}: expected {len(header)} columns (got {len(row)})",
                "$.network.file",
            )
        arcs.append((row[0].strip(), row[1].strip(), float(row[2]) if len(row) == 3 else 1.0))
    return _from_named_arcs(arcs)


def _from_named_arcs(
    arcs: Sequence[tuple[str, str, float]],
) -> tuple[sp.csr_array, tuple[str, ...]]:
    found = dict.fromkeys(end for a, b, _ in arcs for end in (a, b))
    numeric = all(name.isdecimal() for name in found)
    if numeric:
        check_size(max((int(n) for n in found), default=0), "$.network.file")
    # numbers are agent numbers from 1: agents without an arc in between exist as well
    names = (
        tuple(str(k + 1) for k in range(max((int(n) for n in found), default=0)))
        if numeric
        else tuple(found)
    )
    index = {name: k for k, name in enumerate(names)}
    if not arcs:
        raise NetworkError("the file has no arcs", "$.network.file")
    if numeric and "0" in found:
        raise NetworkError("agents are numbered from 1 (got 0)", "$.network.file")
    row, column = [index[b] for _, b, _ in arcs], [index[a] for a, _, _ in arcs]
    weights = [w for _, _, w in arcs]
    return sp.csr_array((weights, (row, column)), shape=(len(names), len(names))), names


def _read_matrix_market(path: Path) -> tuple[sp.csr_array, tuple[str, ...]]:
    """Read it here: SciPy's reader ends the process on some broken files."""
    with path.open(encoding="utf-8") as stream:
        head = stream.readline().lower().split()
        words = [w for line in stream if not line.startswith("%") for w in line.split()]
    form, field, symmetry = head[2:5] if head[:2] == ["%%matrixmarket", "matrix"] else ("",) * 3
    if (
        form not in ("coordinate", "array")
        or field not in ("real", "double", "integer", "pattern")
        or symmetry not in ("general", "symmetric")
    ):
        raise NetworkError(
            f"{path.name}, line 1: expected %%MatrixMarket matrix, coordinate or array, real, "
            f"integer or pattern, general or symmetric (got {' '.join(head)[:60]!r})",
            "$.network.file",
        )
    sizes = 3 if form == "coordinate" else 2
    rows, columns, *entries = (int(word) for word in words[:sizes])
    check_size(max(rows, columns), "$.network.file")
    numbers = np.array(words[sizes:], dtype=float)
    if form == "coordinate":
        wanted = entries[0] * (2 if field == "pattern" else 3)
    else:
        wanted = rows * columns if symmetry == "general" else rows * (rows + 1) // 2
    if numbers.size != wanted:
        raise NetworkError(f"{path.name} has fewer numbers than it says, or more", "$.network.file")
    if form == "coordinate":
        table = numbers.reshape(entries[0], -1) if entries[0] else np.empty((0, 3))
        row, column = table[:, :2].astype(int).T - 1
        values = np.ones(len(table)) if field == "pattern" else table[:, 2]
    else:  # column by column, of a symmetric matrix the lower triangle
        values = numbers
        if symmetry == "general":
            row, column = (k.ravel("F") for k in np.indices((rows, columns)))
        else:
            column, row = np.triu_indices(rows)
    matrix = sp.csr_array((values, (row, column)), shape=(rows, columns))
    if symmetry == "symmetric":
        matrix = sp.csr_array(matrix + sp.triu(matrix.T, 1) + sp.tril(matrix.T, -1))
    return matrix, tuple(str(k + 1) for k in range(rows))


def _read_graphml(path: Path) -> tuple[sp.csr_array, tuple[str, ...]]:
    import networkx

    graph = networkx.read_graphml(path)
    nodes = list(graph.nodes)
    arcs = [(str(a), str(b), float(w)) for a, b, w in graph.edges(data="weight", default=1.0)]
    if not graph.is_directed():
        arcs += [(b, a, w) for a, b, w in arcs]
    index = {str(name): k for k, name in enumerate(nodes)}
    row, column = [index[b] for _, b, _ in arcs], [index[a] for a, _, _ in arcs]
    matrix = sp.csr_array(([w for *_, w in arcs], (row, column)), shape=(len(nodes), len(nodes)))
    return matrix, tuple(str(n) for n in nodes)
