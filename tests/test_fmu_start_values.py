"""Start values that an FMU does not take as they are: found, told, written to the manifest."""

from __future__ import annotations

import html
import json
import logging
from pathlib import Path

import attrs
import numpy as np
import pytest
from fmu_examples import example_1, tank_fmu
from fmu_scenarios import one_fmu

from posmas_fmi import load, run
from posmas_fmi.errors import FmuError, InputError
from posmas_fmi.fmu import start_values
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.start_values import StartValues, read_back, settable, spread
from posmas_fmi.scenario.main_job import scheduled

PUMP = """
from pythonfmu import Fmi2Causality as C, Fmi2Initial as I, Fmi2Slave, Fmi2Variability as V
from pythonfmu import Real, String


class Pump(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.limit, self.density, self.area, self.label = 5.0, 1.0, 2.0, ""
        self.u, self.y = 0.0, 0.0
        self.register_variable(Real("limit", causality=C.parameter, variability=V.tunable))
        self.register_variable(
            Real("density", causality=C.local, variability=V.constant, initial=I.exact)
        )
        self.register_variable(
            Real("area", causality=C.calculatedParameter, variability=V.fixed, initial=I.calculated)
        )
        self.register_variable(Real("u", causality=C.input))
        self.register_variable(Real("y", causality=C.output))
        self.register_variable(String("label", causality=C.parameter, variability=V.tunable))

    def exit_initialization_mode(self):
        self.limit = min(self.limit, 10.0)
        self.label = self.label[:3]

    def do_step(self, t, h):
        self.y = min(self.u, self.limit)
        return True
"""
VALUES = {"limit": 12.0, "density": 2.0, "area": 3.0, "label": "long name", "u": 0.1}


@pytest.fixture(scope="module")
def pump(tmp_path_factory: pytest.TempPathFactory) -> Path:
    builder = pytest.importorskip("pythonfmu.builder", reason="pythonfmu is not installed")
    folder = tmp_path_factory.mktemp("pythonfmu")
    (folder / "pump.py").write_text(PUMP, encoding="utf-8")
    return Path(builder.FmuBuilder.build_FMU(folder / "pump.py", dest=folder))


def test_each_finding_says_what_and_why(pump: Path) -> None:
    with FmuFile(pump) as file, file.instantiate("p") as instance:
        kept, refused = settable(file.about, VALUES, "p")
        assert {f.variable: f.message for f in refused} == {
            "density": "it is a constant",
            "area": "its causality is calculatedParameter",
        }
        assert list(kept) == ["limit", "label", "u"]
        instance.initialise(kept)
        changed = {f.variable: (f.what, f.message) for f in read_back(instance, kept)}
    assert changed == {
        "limit": ("changed", "set to 12, and it is 10"),
        "label": ("changed", "set to 'long name', and it is 'lon'"),
    }


def test_nothing_is_said_where_all_is_as_asked(pump: Path) -> None:
    with FmuFile(pump) as file, file.instantiate("p") as instance:
        values = {"limit": 1 / 3, "label": "abc"}
        instance.initialise(values)
        assert read_back(instance, values) == []


@pytest.mark.parametrize("fmi", [2, 3])
def test_inputs_are_set_before_and_in_initialisation(tmp_path: Path, fmi: int) -> None:
    """What is computed from them in Initialization Mode must know them."""
    calls: list[str] = []
    path = tank_fmu(tmp_path, fmi)
    with FmuFile(path, trace=calls.append) as file, file.instantiate("a") as instance:
        del calls[:]
        instance.initialise({"loss": 1.0, "power": 7.0})
        order = [call[4:] for call in calls if call != "fmi2SetupExperiment"]
    sets = "SetReal" if fmi == 2 else "SetFloat64"
    begin, end = order.index("EnterInitializationMode"), order.index("ExitInitializationMode")
    assert set(order[:begin]) == {sets}
    assert order[begin + 1 : end] == [sets]


def scenario(pump: Path, folder: Path, parameters: str) -> str:
    return one_fmu(folder, pump, '"u"', '"y"', f"parameters = {{{parameters}}}")


def test_a_run_tells_and_keeps_them(
    pump: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = scenario(pump, tmp_path, 'limit = 12.0, area = 3.0, label = "abc"')
    with caplog.at_level(logging.WARNING):
        run(attrs.evolve(load(path), baseline=True), tmp_path / "out")
    told = json.loads((tmp_path / "out" / "manifest.json").read_text())["start_values"]
    assert [(t["variable"], t["what"], t["instances"]) for t in told] == [
        ("area", "not set", ["1", "2"]),
        ("limit", "changed", ["1", "2"]),
    ]
    text = "1 and 1 more: start value 'limit' changed: set to 12, and it is 10"
    assert caplog.text.count(text) == 1  # though the run without control starts them once more
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert any(text in message for message in summary["messages"])
    page = html.unescape((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    assert text in page


def test_a_name_that_is_not_there_is_a_mistake(pump: Path, tmp_path: Path) -> None:
    path = scenario(pump, tmp_path, "limits = 1.0")
    with pytest.raises(InputError, match="no variable 'limits'; did you mean 'limit'"):
        run(load(path), tmp_path / "out", report=False)


def test_arrays_are_start_values(tmp_path: Path) -> None:
    example = example_1()
    with FmuFile(example.fmu(3, tmp_path)) as file, file.instantiate("a") as instance:
        values = {**example.matrices, "x": np.array([1.0, 0.3])}
        kept, refused = settable(file.about, values)
        instance.initialise(kept)
        assert (list(kept), refused, read_back(instance, kept)) == (list(values), [], [])


def test_values_of_the_same_names_and_shapes_are_checked_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thousand instances of one FMU start in a tenth of a second (benchmarks/engine.py)."""
    example, checked = example_1(), []
    monkeypatch.setattr(
        start_values, "spread", lambda *given: checked.append(given) or spread(*given)
    )
    with FmuFile(example.fmu(2, tmp_path)) as file:  # FMI 2: a scalar for each element
        start = StartValues(file)
        for k in range(5):
            values = {**example.matrices, "x": np.array([1.0, 0.1 * k])}
            with file.instantiate(f"{k}") as instance:
                given, refused = start.of(values, instance.name)
                instance.initialise(given)
                assert (refused, read_back(instance, given)) == ([], [])
                assert [instance.get(f"x[{i}]") for i in (1, 2)] == [1.0, 0.1 * k]
                assert instance.get("A[2,1]") == example.A[1, 0]
        once = len(checked)
        start.of({**values, "x": np.array([2.0, 3.0])}, "again")
        assert len(checked) == once
        with pytest.raises(InputError, match=r"no variable 'x\[3\]'"):
            start.of({"x": np.ones(3)}, "three")


def test_findings_are_about_their_own_instance(pump: Path) -> None:
    with FmuFile(pump) as file:
        start = StartValues(file)
        for name in ("a", "b"):
            given, refused = start.of(VALUES, name)
            assert {f.instance for f in refused} == {name}
            assert dict(given) == {"limit": [12.0], "u": [0.1], "label": "long name"}


def test_values_of_another_file_are_resolved_anew(tmp_path: Path) -> None:
    tank = tank_fmu(tmp_path, 3)
    with FmuFile(tank) as one, FmuFile(example_1().fmu(3, tmp_path)) as other:
        given = one.given({"loss": 2.0})
        assert one.given(given) is given
        with pytest.raises(FmuError, match="no variable 'loss'"):
            other.given(given)
        with pytest.raises(InputError, match="expected numbers for 'loss'"):
            one.given({"loss": {"a": 1}})


@pytest.mark.parametrize(
    ("more", "place", "told"),
    [
        ('parameters = {loss = "abc"}', "$.plant.parameters", "expected a number for 'loss'"),
        (
            "parameters = {loss = [1.0, 2.0]}",
            "$.plant.parameters",
            "expected one number for 'loss'",
        ),
        ("parameters = {fi = 1.0}", "$.plant.parameters", "there is no variable 'fi'"),
        (
            "[[plant.override]]\nagent = 2\nparameters = {fi = 1.0}",
            "$.plant.override[0].parameters",
            "there is no variable 'fi'",
        ),
        (
            '[[component]]\nname = "h"\nfmu = "facility_header"\nparameters = {chiller = [1, 2]}',
            "$.component[0].parameters",
            "expected one number for 'chiller'",
        ),
    ],
)
def test_a_start_value_that_cannot_be_one_is_refused_before_anything_runs(
    tmp_path: Path, more: str, place: str, told: str
) -> None:
    path = one_fmu(tmp_path, tank_fmu(tmp_path, 3), '"power"', '"temperature"', more)
    with pytest.raises(InputError) as caught:
        scheduled(load(path))
    assert [where for where, _ in caught.value.problems] == [place]
    assert told in str(caught.value)
