"""Build hook: compile engine and FMUs of the shipped scenarios when the package is installed."""

import shutil
import sys
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CustomBuildHook(BuildHookInterface):
    def dependencies(self):
        # without a system compiler the build brings one along, as a package
        compilers = ("cc", "gcc", "clang")
        return [] if any(shutil.which(name) for name in compilers) else ["ziglang>=0.13"]

    def initialize(self, version, build_data):
        if self.target_name != "wheel":
            return
        root = Path(self.root)
        sys.path.insert(0, str(root))
        try:
            from posmas_fmi.cosim import native
            from posmas_fmi.fmu.build import build_shipped

            models, folder = root / "models", root / "posmas_fmi" / "_built"
            built = build_shipped(models, folder) + native.build_shipped(models, folder)
        finally:
            sys.path.remove(str(root))
        keep = {path.name for path in built}
        for stale in folder.iterdir():
            if stale.name not in keep:
                stale.unlink()
        build_data["pure_python"] = False
        build_data["infer_tag"] = True
