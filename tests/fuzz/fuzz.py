"""Fuzz one reader with atheris: `python tests/fuzz/fuzz.py READER [libFuzzer options]`.

Needs `pip install atheris`. For example, a minute: `... fuzz.py xml -max_total_time=60`.
A run ends with a traceback and a file `crash-...` if a reader raises anything but a typed error.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    """Fuzz the reader named first."""
    import atheris

    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    with atheris.instrument_imports(include=["posmas_fmi"]):
        from fuzz.readers import READERS, beginnings

    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in READERS:
        raise SystemExit(f"expected one of {', '.join(READERS)} (got {name!r})")
    with tempfile.TemporaryDirectory(prefix="posmas-fmi-corpus-") as folder:
        for k, data in enumerate(beginnings(name)):
            Path(folder, f"beginning{k}").write_bytes(data)
        atheris.Setup([sys.argv[0], *sys.argv[2:], folder], READERS[name])
        atheris.Fuzz()


if __name__ == "__main__":
    main()
