"""Models and plants that do not fit are refused with the place of the mistake."""

from __future__ import annotations

from pathlib import Path

import pytest
from fmu_examples import TANK_TOML, example_1, tank

from posmas_fmi.errors import BuildError
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu.description import model_description
from posmas_fmi.fmu.model import FmuModel, Variable
from posmas_fmi.fmu.plant import read_plant, shipped_plants
from posmas_fmi.fmu.positive_agent import positive_agent
from posmas_fmi.resources import shipped


def test_the_order_of_values_is_that_of_model_h(tmp_path: Path) -> None:
    model = tank(tmp_path)
    assert model.references() == {
        "loss": 1,
        "power": 2,
        "temperature": 3,
        "der(temperature)": 4,
        "flow": 5,
        "net": 6,
    }
    assert model.count("output", "local") == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('role = "input"', 'role = "in"', "power: expected one of"),
        ("start = 2.0", "start = [1.0, 2.0]", "loss: expected 1 start values"),
        ("start = 2.0", "start = nan", "loss: start values must be finite"),
        ('start = 100.0\nunit = "W"', 'start = "hot"', "does not fit"),
        ("nominal = 300.0", "nominal = 0.0", "temperature: nominal must be > 0"),
        ('name = "net"', 'name = "flow"', "occur twice: flow"),
        ('depends = ["temperature"]', 'depends = ["net"]', "flow: depends on net"),
        ('name = "tank"', 'name = "../tank"', "expected a C identifier"),
        ('name = "tank"', "", "expected the key 'name'"),
        ("[experiment]", "[experiments]", r"unknown key 'experiments'"),
        ("stop = 100", "stopp = 100", r"\$\.experiment: unknown key 'stopp'"),
        ('role = "local"', 'role = "local"\nsize = 2', r"\$\.variable\['flow'\]: unknown key"),
        ("[experiment]", "[experiment", "cannot read the plant"),
    ],
)
def test_mistakes_in_a_plant_file(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in TANK_TOML
    (tmp_path / "model.toml").write_text(TANK_TOML.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(BuildError, match=message):
        read_plant(tmp_path)


def test_a_plant_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(BuildError, match="cannot read the plant"):
        read_plant(tmp_path)


def test_an_unknown_unit_is_refused() -> None:
    variable = Variable("v", "output", unit="furlong")
    model = FmuModel("m", "", (variable,), {})
    with pytest.raises(BuildError, match="furlong"):
        model_description(model, 3, [])


def test_functions_must_fit_the_sizes() -> None:
    g, sec = example_1().g, example_1().sec
    with pytest.raises(BuildError, match="g: expected 3"):
        positive_agent(g, sec, 3, 1, 1)
    with pytest.raises(BuildError, match="sec: expected 2"):
        positive_agent(g, sec, 2, 2, 1)
    with pytest.raises(BuildError, match="at least one"):
        positive_agent(g, sec, 2, 1, 0)
    mixed = VectorFunction.parse(["u1 + u2", "u2"], ["u1", "u2"])
    with pytest.raises(BuildError, match="component 1 depends on"):
        positive_agent(g, mixed, 2, 2, 1)
    with pytest.raises(BuildError, match="A: expected 4 start values"):
        positive_agent(g, sec, 2, 1, 1, start={"A": [1.0]})


def test_the_shipped_folders_are_found_in_checkout_and_wheel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (shipped("plant_fmus") / "positive_agent" / "model.toml").is_file()
    package = tmp_path / "posmas_fmi"
    (package / "_data" / "plant_fmus" / "a_plant").mkdir(parents=True)
    (package / "_data" / "plant_fmus" / "a_plant" / "model.toml").touch()
    monkeypatch.setattr("posmas_fmi.resources._PACKAGE", package)
    assert list(shipped_plants()) == ["a_plant"]
