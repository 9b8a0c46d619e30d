"""What few FMUs need: structural parameters, input derivatives, one instance per process."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
import test_engine
import xarray
from fmu_examples import tank_fmu
from fmu_scenarios import one_fmu
from test_fmu_events import packed
from test_fmu_instance import described

from posmas_fmi import load, run
from posmas_fmi.cosim.fmu_plant import FmuPlant, PlantSpec, PortMap
from posmas_fmi.errors import FmuCallError, FmuError, InputError
from posmas_fmi.fmu.check.preflight import check_fmu
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.start_values import settable

SIZED = Path(__file__).parent / "sized"


@pytest.fixture(scope="module")
def sized(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packed(tmp_path_factory.mktemp("sized"), (SIZED / "model.c").read_text(), SIZED)


def test_arrays_have_the_length_of_a_structural_parameter(sized: Path) -> None:
    with FmuFile(sized, structure={"m": 4}) as file, file.instantiate("s") as instance:
        assert file.variable("u").shape == file.variable("y").shape == (4,)
        instance.initialise({"gain": [1.0, 2.0, 3.0, 4.0]})
        instance.set({"u": [1.0, 1.0, 1.0, 0.5]})
        instance.do_step(0.0, 0.1)
        assert instance.get("y").tolist() == [1.0, 2.0, 3.0, 2.0]
    with FmuFile(sized) as file:
        assert file.variable("u").shape == (2,)
        assert settable(file.about, {"m": 3})[1][0].what == "not set"


@pytest.mark.parametrize("value", [1.5, -1, "two", [1, 2]])
def test_a_length_is_a_whole_number(sized: Path, value: object) -> None:
    with pytest.raises(InputError, match="whole number >= 0 for 'm'"):
        FmuFile(sized, structure={"m": value})  # type: ignore[dict-item]


def test_structural_parameters_in_a_scenario(sized: Path, tmp_path: Path) -> None:
    more = "parameters = {m = 5, gain = [1, 1, 1, 1, 7]}"
    path = one_fmu(tmp_path, sized, '"u[5]"', '"y[5]"', more, gain=-0.4)
    run(load(path), tmp_path / "out", report=False)
    with xarray.open_dataset(tmp_path / "out" / "results.nc") as data:
        u, y = data["u"].values, data["y"].values
    np.testing.assert_allclose(y[1:], 7.0 * u[:-1], rtol=1e-12)
    assert np.ptp(u) > 0.1
    without = one_fmu(tmp_path, sized, '"u[5]"', '"y[5]"')
    with pytest.raises(InputError, match=r"no variable 'u\[5\]'"):
        run(load(without), tmp_path / "out2", report=False)


def test_what_is_no_start_value_for_an_array(sized: Path, tmp_path: Path) -> None:
    """Each with its place, and before anything runs."""
    two = "[[plant.override]]\nagent = 2\nparameters = "
    for more, told in (
        ("parameters = {gain = [[1, 2], [3]]}", r"parameters: expected rows of the same length"),
        ("parameters = {m = -1}", r"plant.parameters: clocked.fmu: expected a whole number >= 0"),
        (f"{two}{{m = 4}}", r"override\[0\].parameters: .* parameter 'm' to be the same for all"),
        (f"{two}{{m = 4, gain = [1, 2, 3, 4]}}", "use a copy of the file"),
        (f"parameters = {{gain = [1, 2]}}\n{two}{{gain = [1]}}", r"array of shape \(2,\)"),
    ):
        with pytest.raises(InputError, match=told):
            run(load(one_fmu(tmp_path, sized, '"u[1]"', '"y[1]"', more)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_two_inputs_of_the_protocol_at_one_of_the_fmu(sized: Path, tmp_path: Path) -> None:
    text = Path(one_fmu(tmp_path, sized, '"u[1]"', '"y[1]"'))
    text.write_text(
        text.read_text()
        .replace("B = [[0.1]]", "B = [[0.1, 0.1]]")
        .replace("K = [[0.0]]", "K = [[0.0], [0.0]]")
        .replace('{u1 = "u[1]"}', '{u1 = "u[1]", u2 = "u[1]"}')
    )
    with pytest.raises(InputError, match=r"inputs.u2: 'u\[1\]' is set by u1 already"):
        run(load(text), tmp_path / "out")


def test_variables_are_recorded_under_names_that_are_free(sized: Path, tmp_path: Path) -> None:
    """The FMU has a u, a y and a time of its own, and so has the result."""
    slashed = described(sized, tmp_path / "sized.fmu", b'name="gain"', b'name="a/gain"')
    more = 'record = ["time", "u[2]", "m", "a/gain[1]"]\nparameters = {"a/gain" = [2, 3]}'
    path = one_fmu(tmp_path, slashed, '"u[1]"', '"y[1]"', more, gain=-0.4)
    run(load(path), tmp_path / "out")  # with its report
    with xarray.open_dataset(tmp_path / "out" / "results.nc") as data:
        assert {"agents.time", "u[2]", "m", "a|gain[1]"} < set(data)
        assert (data["a|gain[1]"] == 2.0).all()


def test_instances_of_one_file_have_the_same_structure(sized: Path) -> None:
    ports = PortMap.plain(("u[1]",)), PortMap.plain(("y[1]",))
    specs = [PlantSpec(sized, {"m": m}, f"number {m}", *ports) for m in (3, 4)]
    with pytest.raises(InputError, match="number 3 and number 4 differ"):
        FmuPlant(specs, False, 1.0)


def test_one_instance_per_process(tmp_path: Path) -> None:
    old = b'canHandleVariableCommunicationStepSize="true"'
    new = old + b' canBeInstantiatedOnlyOncePerProcess="true"'
    path = described(tank_fmu(tmp_path, 3), tmp_path / "once.fmu", old, new)
    with FmuFile(path) as file:
        with file.instantiate("a"), pytest.raises(FmuError, match="only one instance of it"):
            file.instantiate("b")
        file.instantiate("c").free()


REFUSES = 'return c && nvr == 0 ? fmi2OK : not_provided(c, "interpolation of inputs");'
SETS = "return fmi2SetReal(c, vr, nvr, value);"


def test_inputs_that_are_not_interpolated(tmp_path: Path) -> None:
    with FmuFile(tank_fmu(tmp_path, 2)) as file, file.instantiate("a") as instance:
        instance.initialise()
        with pytest.raises(FmuCallError, match="does not interpolate inputs"):
            instance.set_input_derivatives(file.ports(("power",)), [1.0])


def test_derivatives_of_inputs_reach_the_fmu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The FMU is changed so that it shows what it was told: the input is its derivative."""
    test_engine.changed(monkeypatch, 2, REFUSES, SETS)
    old = b'canHandleVariableCommunicationStepSize="true"'
    new = old + b' canInterpolateInputs="true"'
    path = described(tank_fmu(tmp_path, 2), tmp_path / "rate.fmu", old, new)
    with FmuFile(path) as file, file.instantiate("a") as instance:
        instance.initialise()
        instance.set_input_derivatives(file.ports(("power",)), [12.5])
        assert instance.get("power") == 12.5
        with pytest.raises(FmuError, match="expected 1 values"):
            instance.set_input_derivatives(file.ports(("power",)), [1.0, 2.0])


def test_pending_is_explained(tmp_path: Path) -> None:
    with FmuFile(tank_fmu(tmp_path, 2)) as file, file.instantiate("a") as instance:
        error = instance.status_error("DoStep", 5, ())
    assert "5 (Pending), as if the call went on by itself; such asynchronous" in str(error)


MORE = b"""<Binary name="frame" valueReference="7" causality="input" mimeType="image/png"/>
    <Binary name="seen" valueReference="8" causality="output"/>
    <String name="label" valueReference="9" causality="output"/>
  </ModelVariables>"""
ABLE = b'canHandleVariableCommunicationStepSize="true"'
TERMINALS = b'<!DOCTYPE a [<!ENTITY b "x">]><a>&b;</a>'  # nobody reads it


def test_what_is_not_used_does_no_harm_and_is_listed(sized: Path, tmp_path: Path) -> None:
    """FMI 3: intermediate updates, terminals, binary variables, layered standards."""
    path = described(sized, tmp_path / "more.fmu", b"</ModelVariables>", MORE)
    flags = ABLE + b' providesIntermediateUpdate="true" mightReturnEarlyFromDoStep="true"'
    path = described(path, tmp_path / "most.fmu", ABLE, flags)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("terminalsAndIcons/terminalsAndIcons.xml", TERMINALS)
        archive.writestr("extra/org.example/manifest.xml", "<a/>")
    plain, made = check_fmu(sized), check_fmu(path)
    assert made.exit_code == plain.exit_code < 3, [str(f) for f in made.findings]
    told = {(f.code, f.place) for f in made.findings}
    for place in ("Co-Simulation", "terminalsAndIcons", "extra"):
        assert ("not-used", place) in told
    kinds = [f"{f.place}: {f.message}" for f in made.findings if f.code == "kinds-unused"]
    assert any("frame" in text for text in kinds)
    assert any("seen" in text for text in kinds)
    scenario = one_fmu(tmp_path, path, '"u[1]"', '"y[1]"')
    assert run(load(scenario), tmp_path / "out", report=False).summary["steps"] == 10
