"""What can go wrong with an FMU: each has its typed error, and nothing is left behind."""

from __future__ import annotations

import gc
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import hostile
import numpy as np
import pytest
from fmu_examples import example_1, named, tank_fmu, vector

from posmas_fmi.errors import ArchiveError, FmuCallError, FmuError
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu.archive import entry_names, read_entry
from posmas_fmi.fmu.build import agent_fmu
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fmus")


@pytest.fixture(scope="module", params=[2, 3])
def path(request: pytest.FixtureRequest, cache: Path) -> Path:
    return example_1().fmu(request.param, cache)


@pytest.fixture
def file(path: Path):
    with FmuFile(path) as opened:
        yield opened


@pytest.fixture
def instance(file: FmuFile) -> FmuInstance:
    made = file.instantiate("agent 3")
    made.initialise(named(example_1().matrices | {"x": [1.0, 0.3]}, file.version))
    return made


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that holds all temporary files of a test."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def changed(path: Path, to: Path, change: Callable[[str, bytes], tuple[str, bytes] | None]) -> Path:
    """A copy of an archive with entries changed or (None) left out."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(to, "w") as new:
        for name in old.namelist():
            entry = change(name, old.read(name))
            if entry:
                new.writestr(*entry)
    return to


def described(path: Path, to: Path, old: bytes, new: bytes) -> Path:
    """A copy of an archive with a replacement in its description."""

    def change(name: str, data: bytes) -> tuple[str, bytes]:
        if name == "modelDescription.xml":
            assert old in data
            data = data.replace(old, new)
        return name, data

    return changed(path, to, change)


# ---- calls that the FMU refuses -----------------------------------------------------------------


def test_a_wrong_token_is_refused_with_the_reason(path: Path, tmp_path: Path) -> None:
    with FmuFile(path) as file:
        token = file.token
    wrong = "{00000000-0000-4000-8000-000000000000}"
    other = described(path, tmp_path / "other.fmu", token.encode(), wrong.encode())
    with FmuFile(other) as file, pytest.raises(FmuCallError, match="no instance") as caught:
        file.instantiate("agent 3")
    assert token in str(caught.value)
    assert wrong in str(caught.value)
    assert caught.value.where.startswith("other.fmu: agent 3: fmi")
    assert caught.value.exit_code == 3


@pytest.mark.parametrize("name", ["guid", "3 token"])
def test_an_fmu_that_gives_no_instance_is_asked_why(name: str) -> None:
    """FMUs of PythonFMU, for one, tell what is missing only when they are asked to log."""
    with FmuFile(hostile.path(name)) as file, pytest.raises(FmuCallError, match="is not mine"):
        file.instantiate("a")


def test_an_unknown_value_reference_is_refused(path: Path, tmp_path: Path) -> None:
    """The description names a variable that the binary does not have."""
    with FmuFile(path) as file:
        name = "y[2]" if file.version == 2 else "y"
        old = f'valueReference="{file.variables[name].reference}"'.encode()
    lying = described(path, tmp_path / "lying.fmu", old, b'valueReference="4711"')
    with FmuFile(lying) as file, file.instantiate("agent 3") as instance:
        instance.initialise()
        with pytest.raises(FmuCallError, match="value reference 4711"):
            instance.get(name)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_input_that_is_not_finite_is_refused(instance: FmuInstance, value: float) -> None:
    with pytest.raises(FmuCallError, match=r"u\[1\] must be finite"):
        instance.set({"u[1]": value})
    instance.do_step(0.0, 0.1)  # and changes nothing


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda i: i.do_step(0.5, 0.1), "the instance is at 0"),
        (lambda i: i.do_step(0.0, 0.0), "step > 0"),
        (lambda i: i.do_step(0.0, -0.1), "step > 0"),
        (lambda i: i.do_step(0.0, np.nan), "step > 0"),
        (lambda i: i.do_step(1e9, 1e-9), "step > 0"),
        (lambda i: i.set({"x[1]": 1.0}), r"x(\[1\])? cannot be set in Step Mode"),
        (lambda i: i.set({"y[1]": 1.0}), r"y(\[1\])? cannot be set"),
        (lambda i: i.exit_initialization(), "not allowed in Step Mode"),
        (lambda i: i.enter_initialization(), "not allowed in Step Mode"),
        (lambda i: i.directional_derivative(["x[1]"], ["u[1]"], [1.0]), "no derivative of x"),
        (lambda i: i.directional_derivative(["y[1]"], ["y[1]"], [1.0]), "with respect to y"),
        (lambda i: i.deserialise(b"not a state", 0.0), "not a serialised state"),
    ],
)
def test_calls_out_of_place_are_refused(
    instance: FmuInstance, call: Callable[[FmuInstance], object], message: str
) -> None:
    with pytest.raises(FmuCallError, match=message) as caught:
        call(instance)
    assert caught.value.agent == "agent 3"
    assert caught.value.where.startswith(f"{instance.file.path.name}: agent 3: fmi")


def test_nothing_but_initialisation_before_initialisation(file: FmuFile) -> None:
    with file.instantiate("agent") as instance:
        with pytest.raises(FmuCallError, match="not allowed in Instantiated"):
            instance.do_step(0.0, 0.1)
        instance.initialise()
        instance.terminate()
        with pytest.raises(FmuCallError, match="not allowed in Terminated"):
            instance.do_step(0.0, 0.1)
        assert instance.get("x[1]") == 0.0


def test_the_promised_stop_time_binds(file: FmuFile) -> None:
    with file.instantiate("agent") as instance:
        instance.initialise(stop=1.0)
        instance.do_step(0.0, 1.0)
        with pytest.raises(FmuCallError, match="beyond the stop time 1"):
            instance.do_step(1.0, 0.1)


def without(path: Path, to: Path, function: str) -> Path:
    """A copy of an archive whose binary does not export a function."""
    renamed = function.replace("fmi", "not", 1).encode()

    def change(name: str, data: bytes) -> tuple[str, bytes]:
        if name.startswith("binaries/"):
            assert function.encode() in data
            data = data.replace(function.encode() + b"\0", renamed + b"\0")
        return name, data

    return changed(path, to, change)


def test_a_function_that_the_binary_lacks_is_missed_when_it_is_called(
    path: Path, tmp_path: Path
) -> None:
    with FmuFile(path) as file:
        name = f"fmi{file.version}GetFMU" + ("state" if file.version == 2 else "State")
    with FmuFile(without(path, tmp_path / "poor.fmu", name)) as file:
        instance = file.instantiate("agent")
        instance.initialise()
        instance.do_step(0.0, 0.1)
        with pytest.raises(FmuError, match=f"has no function {name}"):
            instance.get_state()


def test_a_function_without_which_nothing_runs_is_missed_at_once(
    path: Path, tmp_path: Path, temporary: Path
) -> None:
    with FmuFile(path) as file:
        name = f"fmi{file.version}DoStep"
    with pytest.raises(FmuError, match=f"has no function {name}"):
        FmuFile(without(path, tmp_path / "useless.fmu", name))
    assert not list(temporary.iterdir())


def test_each_call_can_be_followed(path: Path) -> None:
    calls: list[str] = []
    with FmuFile(path, trace=calls.append) as file, file.instantiate("agent") as instance:
        instance.initialise()
        instance.do_step(0.0, 0.1)
        assert calls[0] == "dlopen"
        assert calls[-1] == f"fmi{file.version}DoStep"
    assert calls[-1] == f"fmi{file.version}FreeInstance"


def test_a_thousand_instances_share_one_library(path: Path) -> None:
    """Some FMUs take thread-local storage with every load, which runs out."""
    calls: list[str] = []
    with FmuFile(path, trace=calls.append) as file:
        instances = [file.instantiate(f"agent {k}") for k in range(1000)]
        instances[-1].initialise()
        instances[-1].do_step(0.0, 0.1)
    assert calls.count("dlopen") == 1


@pytest.mark.slow
def test_many_variables(path: Path, tmp_path: Path) -> None:
    """200 000 of them are read, and the FMU runs."""
    with FmuFile(path) as file:
        version = file.version
    kind = (
        ("ScalarVariable", "<Real/></ScalarVariable>")
        if version == 2
        else ("Float64", "</Float64>")
    )
    more = "".join(
        f'<{kind[0]} name="more{k}" valueReference="{1000 + k}" causality="local" '
        f'variability="continuous">{kind[1]}'
        for k in range(200_000)
    )
    old = b"</ModelVariables>"
    large = described(path, tmp_path / "large.fmu", old, more.encode() + old)
    with FmuFile(large) as file, file.instantiate("agent") as instance:
        assert len(file.about.names.by_name) > 200_000
        instance.initialise()
        instance.do_step(0.0, 0.1)


# ---- models that fail ---------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[2, 3])
def explosive(request: pytest.FixtureRequest, cache: Path) -> Path:
    """x' = x^2: from x(0) = 1 infinite at t = 1."""
    g = VectorFunction.parse(["x1**2"], ["t", "x1"])
    return agent_fmu(g, VectorFunction.parse(["u1"], ["u1"]), 1, 1, 1, request.param, cache=cache)


def start_of(x: float, fmi: int) -> dict[str, object]:
    return named({"A": [[0.0]], "H": [[1.0]], "B": [[1.0]], "C": [[1.0]], "x": [x]}, fmi)


def test_a_diverging_model_is_an_error_that_names_the_step(explosive: Path) -> None:
    with FmuFile(explosive) as file, file.instantiate("runaway") as instance:
        instance.initialise(start_of(1.0, file.version))
        instance.do_step(0.0, 0.9)
        assert instance.get("x[1]") == pytest.approx(10.0, rel=1e-7)
        before = instance.get_state()
        with pytest.raises(FmuCallError, match=r"the step from 0\.9") as caught:
            instance.do_step(0.9, 0.5)
        assert caught.value.time == 0.9
        assert instance.get("x[1]") == pytest.approx(10.0, rel=1e-7)  # as before the step
        with pytest.raises(FmuCallError, match="restore a state"):
            instance.do_step(0.9, 0.01)
        instance.set_state(before)
        instance.do_step(0.9, 0.05)
        assert instance.get("x[1]") == pytest.approx(20.0, rel=1e-6)


@pytest.mark.parametrize("fmi", [2, 3])
def test_values_that_are_no_numbers_are_errors(cache: Path, fmi: int) -> None:
    g = VectorFunction.parse(["log(x1) + sqrt(x1)"], ["t", "x1"])
    sec = VectorFunction.parse(["u1"], ["u1"])
    path = agent_fmu(g, sec, 1, 1, 1, fmi, cache=cache)
    with FmuFile(path) as file, file.instantiate("undefined") as instance:
        instance.initialise(start_of(-1.0, fmi))
        with pytest.raises(FmuCallError, match=r"der\(x\[1\]\) is not finite"):
            instance.get("der(x[1])")
        with pytest.raises(FmuCallError, match="not finite"):
            instance.do_step(0.0, 0.1)
        with pytest.raises(FmuCallError, match="no finite derivative"):
            instance.directional_derivative(["der(x[1])"], ["x[1]"], [1.0])


# ---- names and shapes ---------------------------------------------------------------------------


def test_names_resolve_to_variables_and_elements(file: FmuFile) -> None:
    ports = file.ports(["y[2]", "x[1]", "y[1]"])
    assert ports.names == ("y[2]", "x[1]", "y[1]")
    with pytest.raises(FmuError, match=r"no variable 'y\[3\]'; did you mean"):
        file.ports(["y[3]"])


def test_arrays_are_read_and_written_whole_or_in_part(cache: Path) -> None:
    example = example_1()
    with FmuFile(example.fmu(3, cache)) as file, file.instantiate("agent") as instance:
        instance.set(example.matrices)
        instance.set({"A[2,1]": 5.0, "x": [1.0, 2.0]})
        instance.initialise({"x[2]": 3.0})
        expected = example.A.copy()
        expected[1, 0] = 5.0
        assert (instance.get("A") == expected).all()
        assert instance.get("x").tolist() == [1.0, 3.0]
        assert instance.get("A[2,2]") == example.A[1, 1]
        assert file.ports(["A", "u"]).names == (*file.ports(["A"]).names, "u[1]")
        with pytest.raises(FmuError, match=r"expected 'A' of shape \(2, 2\)"):
            instance.set({"A": [[1.0, 2.0, 3.0]]})
        with pytest.raises(FmuError, match="expected 2 values"):
            instance.write(file.ports(["x"]), [1.0])


def test_scalars_by_name(cache: Path) -> None:
    for fmi in (2, 3):
        with FmuFile(tank_fmu(cache, fmi)) as file, file.instantiate("tank") as instance:
            instance.initialise({"loss": 1.0})
            assert instance.get("net") == 90.0
            with pytest.raises(FmuError, match=r"expected 'power' of shape \(\)"):
                instance.set({"power": [1.0, 2.0]})


# ---- archives -----------------------------------------------------------------------------------


def test_files_that_are_no_fmu(tmp_path: Path, temporary: Path, path: Path) -> None:
    data = path.read_bytes()
    cases = {
        "empty.fmu": b"",
        "text.fmu": b"hello",
        "short.fmu": data[: len(data) // 2],
        "bad.fmu": data[:2000] + bytes(len(data[2000:6000])) + data[6000:],
    }
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ArchiveError, match=name):
            FmuFile(tmp_path / name)
    for path, told in ((tmp_path / "missing.fmu", "no such file"), (tmp_path, "this is a folder")):
        with pytest.raises(ArchiveError, match=told):
            FmuFile(path)
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize(
    "name", ["../evil", "/evil", "a/../../evil", "C:/evil", "a\\..\\evil", "modelDescription.xml"]
)
def test_unsafe_paths_are_refused(tmp_path: Path, temporary: Path, path: Path, name: str) -> None:
    bad = tmp_path / "bad.fmu"
    bad.write_bytes(path.read_bytes())
    if name == "modelDescription.xml":
        with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(bad, "a") as file:
            file.writestr(name, "twice")
    else:
        with zipfile.ZipFile(bad, "a") as file:
            file.writestr(name, "evil")
    with pytest.raises(ArchiveError):
        FmuFile(bad)
    assert list(temporary.iterdir()) == []
    assert not (tmp_path / "evil").exists()


def test_names_with_backslashes_are_read_as_slashes(path: Path, tmp_path: Path) -> None:
    """Some exporters on Windows write them: 14 of 390 public FMUs."""
    turned = tmp_path / "turned.fmu"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(turned, "w") as new:
        for name in old.namelist():
            entry = zipfile.ZipInfo("x")
            entry.filename = name.replace("/", "\\")
            new.writestr(entry, old.read(name))
    with FmuFile(turned) as file, file.instantiate("a") as instance:
        instance.initialise()
        assert (file.folder / "binaries").is_dir()
    assert entry_names(turned) == [n for n in zipfile.ZipFile(path).namelist() if n[-1] != "/"]
    assert read_entry(turned, "sources/model.h") == read_entry(path, "sources/model.h")


def test_symbolic_links_are_refused(tmp_path: Path, temporary: Path, path: Path) -> None:
    bad = tmp_path / "bad.fmu"
    bad.write_bytes(path.read_bytes())
    link = zipfile.ZipInfo("resources")
    link.external_attr = 0o120777 << 16
    with zipfile.ZipFile(bad, "a") as file:
        file.writestr(link, "/")
    with pytest.raises(ArchiveError, match="unsafe path"):
        FmuFile(bad)
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new", "error", "message"),
    [
        (b"<fmiModelDescription", b"<fmiModelDescriptio", ArchiveError, "well-formed"),
        (b'fmiVersion="', b'fmiVersion="9', FmuError, "."),
        (b"CoSimulation", b"CoSimulatio", FmuError, "Co-Simulation"),
        (b'"positive_agent"', b'"../../positive_agent"', ArchiveError, "no file name"),
        (b'"positive_agent"', b'"other"', FmuError, "expected other"),
    ],
)
def test_descriptions_that_cannot_be_used(
    tmp_path: Path,
    temporary: Path,
    path: Path,
    old: bytes,
    new: bytes,
    error: type[Exception],
    message: str,
) -> None:
    bad = described(path, tmp_path / "bad.fmu", old, new)
    with pytest.raises(error, match=message):
        FmuFile(bad)
    assert list(temporary.iterdir()) == []


def test_a_binary_that_does_not_load(tmp_path: Path, temporary: Path, path: Path) -> None:
    here = Path.cwd()
    with zipfile.ZipFile(path) as archive:
        name = next(n for n in archive.namelist() if n.startswith("binaries/"))
        library = archive.read(name)
    other = library[:18] + b"\x08\x00" + library[20:]  # ELF: for another processor
    for content in (b"", b"\x7fELF garbage", library[: len(library) // 2], other):
        bad = changed(
            path,
            tmp_path / "bad.fmu",
            lambda name, data, c=content: (name, c if name.startswith("binaries") else data),
        )
        with pytest.raises(FmuError, match="cannot be loaded"):
            FmuFile(bad)
    none = changed(
        path,
        tmp_path / "none.fmu",
        lambda name, data: None if name.startswith("binaries") else (name, data),
    )
    with pytest.raises(FmuError, match="the FMU has none"):
        FmuFile(none)
    assert Path.cwd() == here
    assert list(temporary.iterdir()) == []


# ---- nothing is left behind ---------------------------------------------------------------------


def test_the_temporary_folder_goes_on_every_path(path: Path, temporary: Path) -> None:
    with FmuFile(path) as file:
        assert len(list(temporary.iterdir())) == 1
        instance = file.instantiate("left alive")
        instance.initialise()
        state = instance.get_state()
    assert list(temporary.iterdir()) == []
    assert file.closed
    with pytest.raises(FmuCallError, match="freed"):
        instance.get("x[1]")
    with pytest.raises(FmuError, match="closed"):
        file.instantiate("late")
    for thing in (state, instance):
        thing.free()
    file.close()

    with pytest.raises(RuntimeError, match="stop"), FmuFile(path):
        raise RuntimeError("stop")
    assert list(temporary.iterdir()) == []

    forgotten = FmuFile(path).instantiate("forgotten")
    forgotten.initialise()
    del forgotten
    gc.collect()
    assert list(temporary.iterdir()) == []


def test_nothing_is_printed(instance: FmuInstance, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(FmuCallError):
        instance.do_step(7.0, 0.1)
    assert instance.messages[0].startswith("DoStep from 7")
    captured = capfd.readouterr()
    assert (captured.out, captured.err) == ("", "")


def test_names_of_any_kind_are_safe_in_messages(file: FmuFile) -> None:
    with file.instantiate("100 %s%n Ω") as instance, pytest.raises(FmuCallError, match="Ω"):
        instance.do_step(0.0, 0.1)


def test_addresses_are_those_of_the_binary(file: FmuFile, instance: FmuInstance) -> None:
    assert file.address(f"fmi{file.version}DoStep") > 0
    assert instance.component > 0
    with pytest.raises(FmuError, match="no function fmi9DoStep"):
        file.address("fmi9DoStep")


def test_a_thousand_values_at_once_and_one_by_one_agree(instance: FmuInstance) -> None:
    names = [*vector("x", 2), *vector("y", 2), "A[1,1]", "C[2,2]"]
    together = instance.read(instance.file.ports(names * 100))
    assert together.tolist() == [instance.get(name) for name in names] * 100
