"""No module imports from a floor above its own."""

import ast
from pathlib import Path

import pytest

import posmas_fmi

ROOT = Path(posmas_fmi.__file__).parent
FLOORS = {
    "errors": 0, "expression": 0, "interval": 0, "agent": 0, "network": 0, "network_file": 0,
    "resources": 0, "sector": 0, "protocol": 0, "writing": 0, "interrupt": 0, "apart": 0,
    "bounded": 0, "netcdf": 0,
    "certify": 1, "fmu": 1,
    "design": 2,
    "cosim": 3, "export": 3,
    "scenario": 4, "report": 4, "cooling": 4,
    "cli": 5, "__main__": 5, "__init__": 5,
}  # fmt: skip


def floor(path):
    return FLOORS[path.relative_to(ROOT).parts[0].removesuffix(".py")]


def imported(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        yield from (name.split(".")[1] for name in names if name.startswith("posmas_fmi."))


MODULES = sorted(p for p in ROOT.rglob("*.py") if not {"_data", "_built"} & set(p.parts))


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_down(path):
    for name in imported(path):
        assert FLOORS[name] <= floor(path), f"{path.name} imports {name} from a floor above"
