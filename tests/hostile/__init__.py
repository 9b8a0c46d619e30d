"""FMUs with one defect each, made from our own C and XML: `hostile.path("DoStep segv")`.

`DEFECTS` tells for each what `posmas-fmi check` must find; `docs/defects.md` is made from it.
"""

from hostile.corpus import BOUNDS, DEFECTS, Defect, path

__all__ = ["BOUNDS", "DEFECTS", "Defect", "path"]
