"""Building FMUs: valid archives, the same bytes every time, any compiler, any platform."""

from __future__ import annotations

import multiprocessing
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from fmpy.validation import validate_fmu
from fmu_examples import Example, example_1, tank, tank_fmu, wide

from posmas_fmi import resources
from posmas_fmi.errors import BuildError, InputError
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu import compile as compiling
from posmas_fmi.fmu.build import archive, build_plants, build_shipped, cache_folder, file_name, fmu
from posmas_fmi.fmu.compare import regress
from posmas_fmi.fmu.compile import PLATFORMS, buildable, find_compiler, host
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.plant import read_plant, shipped_plants
from posmas_fmi.fmu.positive_agent import positive_agent
from posmas_fmi.fmu.sources import compiled, sources

needs_cc = pytest.mark.skipif(not shutil.which("gcc"), reason="needs gcc")
needs_zig = pytest.mark.skipif(
    not compiling.importlib.util.find_spec("ziglang"), reason="needs the ziglang package"
)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fmus")


@pytest.fixture(autouse=True)
def nothing_prebuilt(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch):
    empty = tmp_path_factory.mktemp("nothing-built")
    monkeypatch.setattr(resources, "prebuilt", lambda: empty)


# ---- the archive --------------------------------------------------------------------------------


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize(
    "path",
    [
        lambda fmi, cache: example_1().fmu(fmi, cache),
        lambda fmi, cache: wide().fmu(fmi, cache),
        lambda fmi, cache: tank_fmu(cache, fmi),
    ],
    ids=["example 1", "other sizes", "written in C"],
)
def test_fmpy_finds_nothing_to_say(cache: Path, fmi: int, path: Callable[..., Path]) -> None:
    assert validate_fmu(str(path(fmi, cache))) == []


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_archive_holds_description_binary_and_sources(cache: Path, fmi: int) -> None:
    names = set(zipfile.ZipFile(example_1().fmu(fmi, cache)).namelist())
    binary = f"binaries/{host().folder(fmi)}/positive_agent{host().extension}"
    wanted = {"modelDescription.xml", binary, "sources/instance.c", f"sources/fmi{fmi}.c"}
    assert wanted <= names
    assert ("sources/buildDescription.xml" in names) == (fmi == 3)


@needs_cc
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("example", [example_1(), wide()])
def test_the_c_sources_have_no_warnings(tmp_path: Path, fmi: int, example: Example) -> None:
    files = sources(example.model(), fmi)
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow", "-Wconversion"]
    for optimise in ("-O0", "-O2"):
        command = ["gcc", *flags, "-Wno-sign-conversion", optimise, "-c", *compiled(files)]
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert run.stderr == ""


@needs_cc
@pytest.mark.parametrize("fmi", [2, 3])
def test_the_sanitisers_find_nothing(tmp_path: Path, fmi: int) -> None:
    files = sources(wide().model(), fmi)
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    shutil.copy(Path(__file__).parent / "fmu_driver.c", tmp_path / "driver.c")
    command = ["gcc", "-std=c99", "-g", "-O1", "-fsanitize=address,undefined"]
    command += ["-fno-sanitize-recover=all", *(["-DDRIVE_FMI2"] if fmi == 2 else [])]
    command += ["driver.c", *(name for name in compiled(files) if name != f"fmi{fmi}.c"), "-lm"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    if run.returncode != 0:
        pytest.skip(f"gcc has no sanitisers here: {run.stderr[-200:]}")
    run = subprocess.run([tmp_path / "a.out"], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")


# ---- the same bytes every time ------------------------------------------------------------------


@pytest.mark.parametrize("fmi", [2, 3])
def test_two_builds_are_byte_identical(fmi: int) -> None:
    model = example_1().model()
    assert archive(model, fmi, (host(),)) == archive(model, fmi, (host(),))


def test_the_name_does_not_depend_on_hash_seed_or_place(tmp_path: Path) -> None:
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from fmu_examples import wide\n"
        "from posmas_fmi.fmu.build import file_name\n"
        "from posmas_fmi.fmu.compile import host\n"
        "print(file_name(wide().model(), 3, (host(),)))"
    )
    here = Path(__file__).resolve().parent
    expected = file_name(wide().model(), 3, (host(),))
    for seed in ("1", "2"):
        run = subprocess.run(
            [sys.executable, "-c", code, str(here)],
            cwd=tmp_path,
            env={"PYTHONHASHSEED": seed, "PYTHONPATH": str(here.parent)},
            capture_output=True,
            text=True,
            check=True,
        )
        assert run.stdout.strip() == expected


def test_everything_that_matters_changes_the_name() -> None:
    base, other = example_1(), wide()
    g = VectorFunction.parse(["x1*sin(0.32*x1*t)", "x2*cos(0.31*x2*t)"], ["t", "x1", "x2"])
    linux, windows = PLATFORMS["x86_64-linux"], PLATFORMS["x86_64-windows"]
    names = {
        file_name(base.model(), 2, (linux,)),
        file_name(base.model(), 3, (linux,)),
        file_name(base.model(), 3, (windows,)),
        file_name(base.model(), 3, (linux, windows)),
        file_name(other.model(), 3, (linux,)),
        file_name(positive_agent(g, base.sec, 2, 1, 2), 3, (linux,)),
        file_name(positive_agent(base.g, base.sec, 2, 1, 1), 3, (linux,)),
        file_name(positive_agent(base.g, base.sec, 2, 1, 2, start={"x": [1.0, 2.0]}), 3, (linux,)),
    }
    assert len(names) == 8


def _build(folder: str) -> str:
    return str(wide().fmu(3, Path(folder)))


def test_two_processes_building_the_same_do_not_collide(tmp_path: Path) -> None:
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        first, second = pool.map(_build, [str(tmp_path)] * 2)
    assert first == second
    assert [path.name for path in tmp_path.iterdir()] == [Path(first).name]  # nothing left behind
    with FmuFile(first) as file:
        assert "u" in file.variables


# ---- prebuilt, cached, shipped ------------------------------------------------------------------


def no_compiler(*_: object) -> None:
    raise AssertionError("nothing should be compiled")


def test_a_cached_fmu_is_not_built_again(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = example_1().fmu(3, cache)
    monkeypatch.setattr(compiling.subprocess, "run", no_compiler)
    assert example_1().fmu(3, cache) == first


def scenario(example: Example, folder: Path, name: str, texts: tuple[list[str], list[str]]) -> None:
    lines = [f"{key} = {value.tolist()}" for key, value in example.matrices.items()]
    lines += [f"g = {texts[0]}".replace("'", '"'), f"sec = {texts[1]}".replace("'", '"')]
    (folder / name).write_text("\n".join(["[agent]", *lines, "sector = [0.9, 1.2]"]) + "\n")


def test_shipped_scenarios_are_found_prebuilt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    models, built = tmp_path / "models", tmp_path / "built"
    models.mkdir()
    texts = (
        ["x1*sin(0.31*x1*t)", "x2*cos(0.31*x2*t)"],
        ["1.2*u1 - 0.3*u1*abs(sin(u1))"],
    )
    example = example_1()
    scenario(example, models, "one.toml", texts)
    same = Example(2 * example.A, example.H, example.B, example.C, example.g, example.sec)
    scenario(same, models, "two.toml", texts)  # other numbers, the same functions
    (models / "foreign.toml").write_text('[plant]\nfmu = "other.fmu"\n')
    paths = build_shipped(models, built)
    count = 2 + 2 * len(shipped_plants())
    assert len(paths) == len(set(paths)) == len(list(built.iterdir())) == count
    monkeypatch.setattr(resources, "prebuilt", lambda: built)
    monkeypatch.setattr(compiling.subprocess, "run", no_compiler)
    assert example_1().fmu(2, tmp_path / "cache") in paths
    assert example_1().fmu(3, tmp_path / "cache") in paths


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[agent\n", "cannot read"),
        ("[agent]\nA = [[1.0]]\n", "expected A, B, C, g and sec"),
        (
            '[agent]\nA = [[1.0]]\nB = [[1.0]]\nC = [[1.0]]\ng = ["__import__(1)"]\nsec = ["u1"]\n',
            "not a function",
        ),
    ],
)
def test_a_scenario_that_cannot_be_built_is_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "broken.toml").write_text(text)
    with pytest.raises(BuildError, match=r"broken\.toml") as caught:
        build_shipped(tmp_path, tmp_path / "out")
    assert message in str(caught.value)


def test_building_imports_nothing_but_numpy_sympy_attrs(tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "for name in ('fmpy', 'scipy', 'control', 'cvxpy', 'lxml', 'xarray', 'networkx'):\n"
        "    sys.modules[name] = None\n"
        "from pathlib import Path\n"
        "from posmas_fmi.fmu.build import build_shipped\n"
        "build_shipped(Path(sys.argv[1]), Path(sys.argv[2]))"
    )
    scenario(example_1(), tmp_path, "one.toml", (["x1", "x2"], ["u1"]))
    root = Path(__file__).resolve().parent.parent
    subprocess.run(
        [sys.executable, "-c", code, str(tmp_path), str(tmp_path / "out")], cwd=root, check=True
    )
    assert len(list((tmp_path / "out").iterdir())) == 2 + 2 * len(shipped_plants())


def test_every_shipped_plant_builds_and_meets_its_reference(tmp_path: Path) -> None:
    names = shipped_plants()
    assert "positive_agent" in names
    for path in build_plants([], tmp_path, [host().name]):
        plant = path.name.rsplit("-", 1)[0]
        assert validate_fmu(str(path)) == []
        assert regress(path, names[plant] / "reference.csv").passed


def test_the_cache_folder_follows_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert cache_folder().parts[-3:] == ("somewhere", "posmas-fmi", "fmu")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder().is_relative_to(Path.home() / ".cache")
    monkeypatch.setattr(sys, "platform", "darwin")
    assert "Caches" in cache_folder().parts


# ---- compilers ----------------------------------------------------------------------------------


def hide_compilers(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.delenv("CC", raising=False)


def test_cc_from_the_environment_comes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "my-cc --special")
    assert find_compiler(host()).command == ("my-cc", "--special")


def test_without_any_compiler_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hide_compilers(monkeypatch, tmp_path)
    monkeypatch.setattr(compiling.importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(BuildError, match="ziglang"):
        example_1().fmu(3, tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert buildable(3) == [host().name]


def test_what_the_compiler_said_is_in_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tank(tmp_path / "tank")
    (tmp_path / "tank" / "model.c").write_text("this is not C\n")
    with pytest.raises(BuildError, match=r"model\.c:1"):
        fmu(read_plant(tmp_path / "tank"), 3, cache=tmp_path)
    monkeypatch.setenv("CC", str(tmp_path / "missing-compiler"))
    with pytest.raises(BuildError, match="missing-compiler"):
        fmu(model, 3, cache=tmp_path)


@needs_zig
@pytest.mark.slow
def test_zig_builds_where_the_system_has_no_compiler(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hide_compilers(monkeypatch, tmp_path)
    assert find_compiler(host()).zig
    names = shipped_plants()
    for path in build_plants(["positive_agent"], tmp_path / "built", [host().name]):
        assert regress(path, names["positive_agent"] / "reference.csv").passed


@needs_zig
@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
def test_one_machine_builds_for_all_platforms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmi: int
) -> None:
    hide_compilers(monkeypatch, tmp_path)
    path = example_1().fmu(fmi, tmp_path, platforms=buildable(fmi))
    assert validate_fmu(str(path)) == []
    wanted = {
        2: {"linux64/{}.so", "win64/{}.dll", "darwin64/{}.dylib"},
        3: {
            "x86_64-linux/{}.so",
            "x86_64-windows/{}.dll",
            "x86_64-darwin/{}.dylib",
            "aarch64-darwin/{}.dylib",
            "aarch64-linux/{}.so",
        },
    }[fmi]
    magic = {".so": b"\x7fELF", "dll": b"MZ", "lib": b"\xcf\xfa\xed\xfe"}
    with zipfile.ZipFile(path) as file:
        binaries = {n for n in file.namelist() if n.startswith("binaries/")}
        assert binaries == {f"binaries/{name.format('positive_agent')}" for name in wanted}
        for name in binaries:
            assert file.read(name).startswith(magic[name[-3:]])
            assert f"fmi{fmi}DoStep".encode() in file.read(name)


@pytest.mark.parametrize(
    ("names", "fmi", "message"),
    [
        (["x86_64-linux", "vax-vms"], 3, "vax-vms"),
        ([], 3, "expected platforms"),
        (["x86_64-darwin", "aarch64-darwin"], 2, "one folder"),
        (None, 4, "expected FMI version 2 or 3"),
    ],
)
def test_platforms_and_versions_that_do_not_exist(
    tmp_path: Path, names: list[str] | None, fmi: int, message: str
) -> None:
    with pytest.raises(BuildError, match=message):
        example_1().fmu(fmi, tmp_path, platforms=names)


def test_an_unknown_plant_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no plant 'nothing'"):
        build_plants(["nothing"], tmp_path)


def test_a_cache_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BuildError, match="cannot write"):
        example_1().fmu(3, tmp_path / "file")
