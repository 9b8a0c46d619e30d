"""Ports that are no doubles, in an FMU of another tool; steps that return early."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray
from fmu_examples import example_1, named, vector
from fmu_scenarios import one_fmu

from posmas_fmi import load, run
from posmas_fmi.errors import FmuError
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance, Step

VALVE = """
from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Integer, Real, String

KINDS = {"stage": Integer, "open": Boolean, "flow": Real, "label": String}


class Valve(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.stage, self.open, self.flow, self.label = 0, False, 0.0, ""
        self.seen_stage, self.seen_open, self.seen_flow, self.seen_label = 0, False, 0.0, ""
        for name, kind in KINDS.items():
            self.register_variable(kind(name, causality=Fmi2Causality.input))
            self.register_variable(kind("seen_" + name, causality=Fmi2Causality.output))

    def do_step(self, t, h):
        for name in KINDS:
            setattr(self, "seen_" + name, getattr(self, name))
        return True
"""
SEEN = ("seen_flow", "seen_stage", "seen_open")


@pytest.fixture(scope="module")
def valve(tmp_path_factory: pytest.TempPathFactory):
    builder = pytest.importorskip("pythonfmu.builder", reason="pythonfmu is not installed")
    folder = tmp_path_factory.mktemp("pythonfmu")
    script = folder / "valve.py"
    script.write_text(VALVE, encoding="utf-8")
    path = Path(builder.FmuBuilder.build_FMU(script, dest=folder))
    with FmuFile(path) as file, file.instantiate("valve") as instance:
        instance.initialise({"stage": 4, "open": True, "flow": 0.5, "label": "Kühler"})
        yield instance


def test_integers_booleans_and_texts_are_set_and_read(valve: FmuInstance) -> None:
    valve.set({"stage": -7, "open": False, "flow": 0.25, "label": "Kühler"})
    valve.do_step(valve.time, 0.5)
    assert [valve.get(name) for name in SEEN] == [0.25, -7, 0]
    assert valve.get("seen_label") == "Kühler"


def test_ports_of_any_type_are_numbers(valve: FmuInstance) -> None:
    file = valve.file
    valve.write(file.ports(("open", "flow", "stage")), [0.7, 1.5, 2.6])
    valve.do_step(valve.time, 0.5)
    assert valve.read(file.ports(SEEN)).tolist() == [1.5, 3.0, 1.0]
    assert len(file.ports(SEEN).groups) == 3


@pytest.mark.parametrize(
    ("value", "message"),
    [(np.nan, "finite"), (3e9, "from -2147483648 to 2147483647"), (-3e9, "got -3e")],
)
def test_values_that_do_not_fit_are_refused(valve: FmuInstance, value: float, message: str) -> None:
    with pytest.raises(FmuError, match=message):
        valve.write(valve.file.ports(("stage",)), [value])


def test_what_is_no_number_is_no_port(valve: FmuInstance) -> None:
    with pytest.raises(FmuError, match="'label' to be a number"):
        valve.file.ports(("label",))
    with pytest.raises(FmuError, match="whole numbers for 'stage'"):
        valve.set({"stage": 1.5})
    with pytest.raises(FmuError, match="a text for 'label'"):
        valve.set({"label": 1.0})
    with pytest.raises(FmuError, match="ports that are doubles"):
        _ = valve.file.ports(("stage",)).references


def test_a_step_that_returns_early_is_continued_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    example, once, calls = example_1(), FmuInstance.step_once, []

    def early(self: FmuInstance, time: float, step: float) -> Step:
        """Never more than 0.03 s at once."""
        calls.append(time)
        done = once(self, time, min(step, 0.03))
        return Step(done.reached, step > 0.03)

    with FmuFile(example.fmu(3, tmp_path)) as file:
        values = named(example.matrices | {"x": [1.0, 0.3]}, 3)
        found = []
        for function in (once, early):
            monkeypatch.setattr(FmuInstance, "step_once", function)
            with file.instantiate("agent") as instance:
                instance.initialise(values)
                instance.do_step(0.0, 0.1)
                assert instance.time == 0.1
                found.append(instance.read(file.ports(vector("x", 2))))
    assert len(calls) == 4
    assert found[0] == pytest.approx(found[1], abs=1e-8)


def test_an_fmu_that_never_gets_to_the_end_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FmuInstance, "step_once", lambda self, time, step: Step(time, True))
    with FmuFile(example_1().fmu(3, tmp_path)) as file, file.instantiate("stuck") as instance:
        instance.initialise()
        with pytest.raises(FmuError, match="returned early 101 times"):
            instance.do_step(0.0, 0.1)


LAG = """
from pythonfmu3 import Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability

class Lag(Fmi3Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time, self.u, self.y, self.rate = 0.0, 0.0, 1.0, 2.0
        independent, continuous = Fmi3Causality.independent, Fmi3Variability.continuous
        self.register_variable(Float64("time", causality=independent, variability=continuous))
        self.register_variable(Float64("u", causality=Fmi3Causality.input))
        self.register_variable(Float64("y", causality=Fmi3Causality.output))
        self.register_variable(
            Float64("rate", causality=Fmi3Causality.parameter, variability=Fmi3Variability.tunable)
        )

    def do_step(self, t, h):
        self.y += h * self.rate * (self.u - self.y)
        return True
"""


@pytest.mark.parametrize("isolation", ["none", "process"])
def test_an_fmi_3_fmu_of_pythonfmu3_in_a_scenario(tmp_path: Path, isolation: str) -> None:
    """Agents of one that another tool has built, against what its Python says."""
    builder = pytest.importorskip("pythonfmu3.builder", reason="pythonfmu3 is not installed")
    script = tmp_path / "lag.py"
    script.write_text(LAG, encoding="utf-8")
    fmu = Path(builder.FmuBuilder.build_FMU(script, dest=tmp_path))
    more = f'isolation = "{isolation}"\nparameters = {{rate = 3.0}}'
    path = one_fmu(tmp_path, fmu, '"u"', '"y"', more, gain=-0.4)
    summary = run(load(path), tmp_path / "out", report=False).summary
    assert summary["ended"] == "complete", summary["reason"]
    with xarray.open_dataset(tmp_path / "out" / "results.nc") as data:
        u, y = data["u"].values, data["y"].values
    np.testing.assert_allclose(y[1:], y[:-1] + 0.1 * 3.0 * (u[:-1] - y[:-1]), rtol=1e-12)
    assert (y[0] == 1.0).all()
    assert np.ptp(u) > 0.1
