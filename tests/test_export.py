"""Exported controllers do what was simulated: as FMUs, as C, and in other masters."""

from __future__ import annotations

import json
import shlex
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import attrs
import fmpy
import numpy as np
import peers
import pytest
import xarray
from fmpy.validation import validate_fmu
from lxml import etree
from test_fmu_instance import described

from posmas_fmi import load, run
from posmas_fmi.agent import linear_agent
from posmas_fmi.cli import main
from posmas_fmi.cosim import engine
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.errors import BuildError, FmuError, InputError
from posmas_fmi.export import Component, Connection, Connector, Controllers, Structure, ssp
from posmas_fmi.fmu import compile as compiling
from posmas_fmi.fmu.build import agent_fmu
from posmas_fmi.fmu.check.preflight import check_fmu
from posmas_fmi.fmu.compile import find_compiler, host
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.model import FmuModel, Variable
from posmas_fmi.fmu.model_exchange import ModelExchangeFile
from posmas_fmi.network import network_from_arcs
from posmas_fmi.protocol import make_protocol
from posmas_fmi.resources import shipped
from posmas_fmi.scenario import Scenario
from posmas_fmi.scenario.export import Exported, export
from posmas_fmi.scenario.job import extras, law_network, make_design_of, make_system
from posmas_fmi.scenario.plant import fmu_files, make_instances
from posmas_fmi.scenario.tables import ControlTable

TANH = (shipped("models") / "paper_example_1_tanh.toml").read_text(encoding="utf-8")
STEPS, H = 200, 0.005
XHAT = "[[0.1, 0.0], [0.0, 0.2], [0.3, 0.1], [0.0, 0.0]]"
SCENARIOS = {
    "local": TANH.replace("xhat = 0.0", f"xhat = {XHAT}"),
    "distributed": TANH.replace("xhat = 0.0", f"xhat = {XHAT}").replace(
        "phi = 10.0", 'phi = 10.0\nobserver = "distributed"\nmu = 0.7'
    ),
}


def written(folder: Path, text: str) -> Path:
    path = folder / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    return path


class Made:
    """A scenario, its export, and its run here with messages that take one period."""

    def __init__(self, folder: Path, text: str) -> None:
        self.scenario = load(written(folder, text))
        self.exported: Exported = export(self.scenario, folder / "export")
        self.folder = folder / "export"
        late = load(written(folder, f"{text}\n[channel]\ndelay = {H}\n"), until=STEPS * H)
        run(late, folder / "run", report=False)
        with xarray.open_dataset(folder / "run" / "results.nc") as results:
            self.results = results.load()
        self.agents = json.loads((self.folder / "agents.json").read_text())["agents"]


@pytest.fixture(scope="module", params=list(SCENARIOS))
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Made:
    return Made(tmp_path_factory.mktemp(request.param), SCENARIOS[request.param])


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return Made(tmp_path_factory.mktemp("local_alone"), SCENARIOS["local"])


# ---- the same as simulated -----------------------------------------------------------------------


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_fmus_do_what_was_simulated(made: Made, fmi: int) -> None:
    """Each is told the y of the run, and messages are passed on after each step (Jacobi)."""
    run, names = made.results, [agent["name"] for agent in made.agents]
    width = len(made.agents[0]["values"]["heard"][0])
    with FmuFile(made.folder / f"controller-fmi{fmi}.fmu") as file:
        instances = [file.instantiate(name) for name in names]
        for i, (one, agent) in enumerate(zip(instances, made.agents, strict=True)):
            one.initialise(spread(fmi, {**agent["values"], "y": run.y.values[0, i]}))
        u = []
        for k in range(STEPS):
            u.append([read(fmi, one, "u", 1) for one in instances])
            sent = [read(fmi, one, "sent", width) for one in instances]
            for i, (one, agent) in enumerate(zip(instances, made.agents, strict=True)):
                heard = np.array(agent["values"]["heard"])
                for place, name in enumerate(agent["hears"]):
                    heard[place] = sent[names.index(name)]
                given = {"y": run.y.values[k, i], "heard": heard, "s": run.s.values[k]}
                one.set(spread(fmi, given))
                one.do_step(k * H, H)
        xhat = [read(fmi, one, "xhat", 2) for one in instances]
    assert np.abs(np.array(u) - run.u.values[:STEPS]).max() < 1e-12 * np.abs(u).max()
    assert np.abs(np.array(xhat) - run.xhat.values[STEPS]).max() < 1e-12


def spread(fmi: int, values: dict[str, Any]) -> dict[str, Any]:
    """By element for FMI 2."""
    if fmi == 3:
        return values
    return {
        f"{name}[{','.join(str(k + 1) for k in index)}]" if index else name: float(value)
        for name, array in values.items()
        for index, value in np.ndenumerate(np.asarray(array, dtype=float))
    }


def read(fmi: int, instance: Any, name: str, count: int) -> np.ndarray:
    if fmi == 3:
        return np.asarray(instance.get(name))
    return np.array([float(instance.get(f"{name}[{k + 1}]")) for k in range(count)])


def test_the_c_code_does_what_was_simulated(made: Made, tmp_path: Path) -> None:
    """Without a warning, and the example reads what was measured and writes the inputs."""
    program = built(made.folder / "c", tmp_path)
    measured, u = simulated(made.scenario)
    assert np.abs(inputs_of(program, measured, H) - u).max() < 1e-12 * np.abs(u).max()
    bad = subprocess.run(
        [program], input="h\n0.0,1.0\n", capture_output=True, text=True, check=False
    )
    assert bad.returncode == 1
    assert "expected t and 8 values" in bad.stderr


@pytest.mark.parametrize(
    "law", ["integral", "integral_ff", "proportional", "set_point", "pi", "team"]
)
def test_cooling_controllers_in_c(tmp_path: Path, law: str) -> None:
    """Those of a row with noise, rounded sensors, loads that step and a new set-point."""
    text = (shipped("models") / "cooling_row.toml").read_text(encoding="utf-8")
    text = text[: text.index("[channel]")] + f'[compare]\ncontrollers = ["{law}"]\n'
    scenario = load(written(tmp_path, text), until=4000.0)
    made = export(scenario, tmp_path / "export", controller=law)
    assert made.no_fmu == made.no_ssp
    assert "only the protocol (6) is exported as an FMU" in made.no_fmu
    assert {path.name for path in made.files} == {"c", "agents.json", "design.json", "README.md"}
    told = json.loads((made.folder / "agents.json").read_text())
    assert told["agents"][0]["ports"]["u1"]["variable"] == "valve"
    assert told["agents"][0]["ports"]["u1"]["scale"] < 0
    assert list(told["measured"]) == ["power", "valve", "water"]
    program = built(made.folder / "c", tmp_path)
    alone = attrs.evolve(scenario, compare=None, control=ControlTable(law))
    measured, u = simulated(alone)
    assert np.ptp(u) > 1000  # W
    assert np.abs(inputs_of(program, measured, 5.0) - u).max() < 1e-9 * np.abs(u).max()


def built(folder: Path, to: Path) -> Path:
    """The example program."""
    compiler = find_compiler(host())
    strict = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off"]
    sources = [str(folder / name) for name in ("network.c", "agent.c", "controller.c")]
    command = [*compiler.command, *strict, *sources, "-o", str(to / "network"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{shlex.join(command)}\n{done.stderr}"
    return to / "network"


def simulated(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """What the agents measured (steps, N, …) and their inputs, by the engine."""
    designed = make_design_of(scenario)
    designed = attrs.evolve(designed, network=law_network(scenario, designed))
    instances = make_instances(scenario, fmu_files(scenario), extras(scenario))
    rows: dict[str, list[np.ndarray]] = {"measured": [], "u": []}

    def record(_: np.ndarray, values: dict[str, np.ndarray]) -> None:
        for name, kept in rows.items():
            kept.extend(values[name].copy())

    with instances.start(quiet=True) as plant:
        system = make_system(scenario, designed, instances)
        choice = engine.choose(system.law, "c")
        engine.run(system, plant, record, variables=("measured", "u"), choice=choice)
    return np.array(rows["measured"]), np.array(rows["u"])


def inputs_of(program: Path, measured: np.ndarray, h: float) -> np.ndarray:
    """What the example makes of it, (steps, N, 1)."""
    steps, agents = measured.shape[:2]
    lines = measured.reshape(steps, -1).tolist()
    rows = [",".join(map(repr, [k * h, *line])) for k, line in enumerate(lines)]
    told = "\n".join(["time,measured", *rows, ""])
    said = subprocess.run([program], input=told, capture_output=True, text=True, check=True).stdout
    head, *found = said.splitlines()
    assert head == "time," + ",".join(f"agent{i + 1}.u1" for i in range(agents))
    numbers = [[float(cell) for cell in line.split(",")[1:]] for line in found]
    return np.array(numbers).reshape(steps, agents, 1)


def test_ecos_does_with_the_ssp_file_what_was_simulated(local: Made) -> None:
    try:
        peers._load_tbb()
        from ecospy import EcosSimulation
    except (ImportError, OSError) as reason:
        pytest.skip(f"ecospy is not installed: {reason}")
    rows = []
    with EcosSimulation(H, ssp_path=str(ssp_file(local))) as simulation:
        simulation.init(parameter_set="start")
        for _ in range(STEPS):
            rows.append([one(simulation.get_real, "::", i) for i in range(4)])
            simulation.step(1)
    assert largest_difference(np.array(rows), local.results, slice(0, STEPS)) < 1e-9


def test_libcosim_does_with_the_ssp_file_what_was_simulated(local: Made, tmp_path: Path) -> None:
    """It takes start values of parameters and inputs from the file, not those of states."""
    try:
        from libcosimpy.CosimExecution import CosimExecution
        from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
        from libcosimpy.CosimObserver import CosimObserver
    except (ImportError, OSError) as reason:
        pytest.skip(f"libcosimpy is not installed: {reason}")
    log_output_level(CosimLogLevel.FATAL)
    rows, file = [], ssp_file(local)
    with peers.temporary_files():
        execution = CosimExecution.from_ssp_file(str(file), round(H * 1e9))
        observer = CosimObserver.create_last_value()
        execution.add_observer(observer)
        references: dict[str, dict[str, int]] = {}
        for component in ET.fromstring(description(file)).iter(f"{SSD}Component"):
            name, fmu = component.get("name", ""), component.get("source", "")
            with zipfile.ZipFile(file) as archive:
                path = archive.extract(fmu, tmp_path)
            variables = fmpy.read_model_description(path, validate=False).modelVariables
            references[name] = {v.name: v.valueReference for v in variables}
            slave = execution.slave_index_from_instance_name(name)
            for parameter in component.iter(f"{SSV}Parameter"):
                variable = parameter.get("name", "")
                if variable.startswith("x"):
                    value = float(parameter[0].get("value", ""))
                    execution.real_initial_value(slave, references[name][variable], value)

        def get(text: str) -> float:
            name, variable = text.split("::")
            slave = execution.slave_index_from_instance_name(name)
            return observer.last_real_values(slave, [references[name][variable]])[0]

        for _ in range(STEPS):
            assert execution.step(1)
            rows.append([one(get, "::", i) for i in range(4)])
    assert largest_difference(np.array(rows), local.results, slice(1, STEPS + 1)) < 1e-9


SSD = "{http://ssp-standard.org/SSP1/SystemStructureDescription}"
SSC = "{http://ssp-standard.org/SSP1/SystemStructureCommon}"
SSV = "{http://ssp-standard.org/SSP1/SystemStructureParameterValues}"


def ssp_file(made: Made) -> Path:
    return made.folder / "paper-example-1-tanh.ssp"


def description(path: Path) -> bytes:
    with zipfile.ZipFile(path) as archive:
        return archive.read("SystemStructure.ssd")


def one(get: Callable[[str], float], between: str, i: int) -> list[float]:
    """y, u and xhat of agent i."""
    plant = [f"plant_{i + 1}{between}y[{j}]" for j in (1, 2)]
    law = [f"controller_{i + 1}{between}{name}" for name in ("u[1]", "xhat[1]", "xhat[2]")]
    return [get(name) for name in (*plant, *law)]


def largest_difference(rows: np.ndarray, run: xarray.Dataset, points: slice) -> float:
    own = np.concatenate([run[name].values[points] for name in ("y", "u", "xhat")], axis=2)
    assert np.ptp(own[:, :, 2]) > 1  # something happens
    return float(np.abs(rows - own).max())


# ---- what is written -----------------------------------------------------------------------------


def test_the_files_keep_to_their_standards(made: Made) -> None:
    schema = Path(fmpy.__file__).parent / "ssp" / "schema" / "SystemStructureDescription.xsd"
    valid = etree.XMLSchema(etree.parse(schema))
    valid.assertValid(etree.fromstring(description(ssp_file(made))))
    for fmi in (2, 3):
        assert validate_fmu(str(made.folder / f"controller-fmi{fmi}.fmu")) == []


def test_the_same_scenario_gives_the_same_bytes(local: Made, tmp_path: Path) -> None:
    again = export(local.scenario, tmp_path / "again")
    assert len(again.files) == 7
    for path in again.files:
        if path.is_file():
            assert path.read_bytes() == (local.folder / path.name).read_bytes(), path.name


def test_the_preflight_of_an_exported_controller(made: Made) -> None:
    values = spread(2, made.agents[0]["values"])
    found = check_fmu(made.folder / "controller-fmi2.fmu", values=values, control=False)
    assert [one.severity for one in found.findings if one.severity in ("fatal", "error")] == []
    noise = {name: value for name, value in found.results.items() if name.endswith("_noise")}
    assert noise == dict.fromkeys(
        ("reset_noise", "replay_noise", "serialise_noise", "repeat_noise"), 0.0
    )


def test_the_preflight_tells_what_an_fmu_says(local: Made) -> None:
    found = check_fmu(local.folder / "controller-fmi3.fmu", control=False)
    (fatal,) = [one for one in found.findings if one.severity == "fatal"]
    assert fatal.place == "fmi3ExitInitializationMode"
    said = 'it returned status 3 (Error); it said "it cannot start: its parameter own is 0'
    assert said in fatal.message


def test_what_the_readme_says_of_the_proof(local: Made, tmp_path: Path) -> None:
    text = (local.folder / "README.md").read_text()
    assert "Certified: yes" in text
    assert "a period old. The certificate covers that: certificate D" in text
    assert local.exported.delay["covered"] is True
    gains = 'method = "gains"\nK = [[0.0, 0.0]]\nE = [[0.0, 0.0], [0.0, 0.0]]'
    weak = TANH.replace('method = "contraction"', gains)
    made = export(load(written(tmp_path, weak)), tmp_path / "export")
    assert made.design.certificate.certified == "no"
    assert "does NOT cover that: nothing is proved" in (made.folder / "README.md").read_text()


FACILITY = """
[signals.load]
times = [0.0, 0.5]
values = [1.0, 2.0]

[[component]]
name = "shared"
fmu = "positive_agent"
parameters = {A = [[-1.0, 0.0], [0.0, -1.0]], C = [[1.0, 0.0], [0.0, 1.0]]}
exogenous = {"u[1]" = "load"}

[[component]]
name = "leader"
fmu = "positive_agent"

[[connection]]
source = "shared.y[1]"
to = "leader.u[1]"
scale = 2.0
offset = 0.5
"""
MAPPED = '{variable = "u[1]", scale = 0.5, offset = 0.25}'


def test_ports_components_and_signals_in_the_ssp_file(tmp_path: Path) -> None:
    text = TANH.replace('{u1 = "u[1]"}', f"{{u1 = {MAPPED}}}")
    text = text.replace('y1 = "y[1]"', 'y1 = {variable = "y[1]", scale = 4.0, offset = 1.0}')
    made = export(load(written(tmp_path, text + FACILITY)), tmp_path / "export")
    assert made.no_ssp == ""
    root = ET.fromstring(description(made.folder / "paper-example-1-tanh.ssp"))
    system = root.find(f"{SSD}System")
    assert system is not None
    outer = system.find(f"{SSD}Connectors")
    assert outer is not None
    assert [connector.get("name") for connector in outer] == ["load"]
    wires = {}
    for wire in system.iter(f"{SSD}Connection"):
        keys = ("startElement", "startConnector", "endElement", "endConnector")
        scaled = wire.find(f"{SSC}LinearTransformation")
        by = (1.0, 0.0) if scaled is None else (scaled.get("factor"), scaled.get("offset"))
        wires[" ".join(wire.get(key) or "" for key in keys)] = tuple(map(float, by))
    assert wires["controller_1 u[1] plant_1 u[1]"] == (0.5, 0.25)
    assert wires["plant_1 y[1] controller_1 y[1]"] == (0.25, -0.25)
    assert wires["plant_1 y[2] controller_1 y[2]"] == (1.0, 0.0)
    assert wires["controller_2 sent[1] controller_1 heard[1,1]"] == (1.0, 0.0)
    assert wires[" load shared u[1]"] == (1.0, 0.0)
    assert wires["shared y[1] leader u[1]"] == (2.0, 0.5)
    assert wires["leader_2 y[2] controller_2 s[2]"] == (1.0, 0.0)  # "leader" is a component here
    assert not any("controller_1 s[" in wire for wire in wires)  # not pinned


def test_a_name_twice_among_the_fmus(tmp_path: Path) -> None:
    paths = [tmp_path / folder / "same.fmu" for folder in ("a", "b")]
    for path in paths:
        path.parent.mkdir()
        path.write_text(path.parent.name)
    port = (Connector("y", "output"),)
    components = tuple(Component(path.parent.name, path, port) for path in (*paths, paths[0]))
    (tmp_path / "s.ssp").write_bytes(
        ssp(Structure("s", components, (Connection(("a", "y"), ("", "out")),)))
    )
    with zipfile.ZipFile(tmp_path / "s.ssp") as archive:
        assert archive.namelist() == [
            "SystemStructure.ssd",
            "resources/same.fmu",
            "resources/same-2.fmu",
        ]
        assert archive.read("resources/same-2.fmu") == b"b"


# ---- what cannot be ------------------------------------------------------------------------------


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_controller_without_the_data_of_an_agent_does_not_start(local: Made, fmi: int) -> None:
    says = pytest.raises(FmuError, match="parameter own is 0: set the parameters of an agent")
    path = local.folder / f"controller-fmi{fmi}.fmu"
    with FmuFile(path) as file, file.instantiate("x") as one, says:
        one.initialise({})


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_step_is_one_period(local: Made, fmi: int) -> None:
    values = spread(fmi, local.agents[0]["values"])
    with FmuFile(local.folder / f"controller-fmi{fmi}.fmu") as file, file.instantiate("x") as one:
        one.initialise(values)
        with pytest.raises(FmuError, match=r"it is sampled: every step takes 0\.005 s"):
            one.do_step(0.0, 0.01)


def test_it_goes_back_to_a_saved_state(local: Made) -> None:
    values = spread(3, local.agents[0]["values"])
    with FmuFile(local.folder / "controller-fmi3.fmu") as file, file.instantiate("x") as one:
        one.initialise(values)
        one.set({"y": [1.0, 2.0]})
        one.do_step(0.0, H)
        state = one.get_state()
        seen = []
        for _ in range(2):
            one.set_state(state)
            one.set({"y": [0.5, 0.1]})
            one.do_step(H, H)
            seen.append((one.get("u").tobytes(), one.get("sent").tobytes()))
        assert seen[0] == seen[1]


def test_a_sampled_fmu_has_no_model_exchange(local: Made, tmp_path: Path) -> None:
    """Whatever its description were made to say."""
    more = b'<ModelExchange modelIdentifier="controller"/><CoSimulation '
    made, to = local.folder / "controller-fmi3.fmu", tmp_path / "forged.fmu"
    forged = described(made, to, b"<CoSimulation ", more)
    with ModelExchangeFile(forged) as file, pytest.raises(FmuError, match="no Model Exchange"):
        file.instantiate("x")


def test_a_sampled_fmu_has_no_directional_derivatives(local: Made) -> None:
    with FmuFile(local.folder / "controller-fmi3.fmu") as file, file.instantiate("x") as one:
        one.initialise(spread(3, local.agents[0]["values"]))
        with pytest.raises(FmuError, match="no directional derivatives"):
            one.directional_derivative(["u"], ["y"], [1.0, 1.0])


def test_only_a_sampled_model_has_memory() -> None:
    memory = Variable("m", "memory")
    with pytest.raises(BuildError, match="only a sampled model has memory"):
        FmuModel("x", "", (memory,), {})
    with pytest.raises(BuildError, match="expected a period > 0 s"):
        FmuModel("x", "", (memory,), {}, period=0.0)


REFUSED = {
    "printed": (
        "phi = 10.0",
        'phi = 10.0\nprotocol = "printed"',
        "paper prints the network is unstable",
    ),
    "integral": ('method = "contraction"', 'method = "integral"', "with integrals is not exported"),
    "own": ("[leader]", '[control]\npython = "own.py:Own"\n[leader]', "in Python: not exported"),
    "periods": ("[leader]", "[[plant.override]]\nagent = 2\nevery = 2\n[leader]", "period"),
}


@pytest.mark.parametrize(("old", "new", "says"), REFUSED.values(), ids=REFUSED)
def test_what_is_not_exported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, says: str
) -> None:
    (tmp_path / "own.py").write_text("class Own:\n    def __init__(self, number): ...\n")
    path = written(tmp_path, TANH.replace(old, new))
    assert main(["export", str(path), "--out", str(tmp_path / "export")]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert str(path) in said
    assert not (tmp_path / "export").exists()


def test_which_controller_of_a_comparison(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = ["--out", str(tmp_path / "export")]
    assert main(["export", "cooling_row", *folder]) == 2
    assert "--controller: choose one of pi, integral, integral_ff" in capsys.readouterr().err
    assert main(["export", "cooling_row", *folder, "--controller", "pid"]) == 2
    assert "fixed (got 'pid')" in capsys.readouterr().err
    assert main(["export", "paper_example_1", *folder, "--controller", "pi"]) == 2
    assert "the scenario compares no controllers" in capsys.readouterr().err
    assert not (tmp_path / "export").exists()
    assert main(["export", "cooling_row", *folder, "--controller", "fixed"]) == 1
    said = capsys.readouterr().out
    assert "no FMUs and no SSP file: the input of this law follows" in said
    assert "certified  no" in said
    assert "one period" not in said
    assert "does NOT cover that: nothing is proved" in (tmp_path / "export/README.md").read_text()


def test_a_law_that_is_not_there_in_c(tmp_path: Path) -> None:
    text = (shipped("models") / "cooling_row.toml").read_text(encoding="utf-8")
    text = text[: text.index("[compare]")] + '[compare]\ncontrollers = ["mpc"]\n'
    text = text.replace("set_point_step", "# ")  # it knows one set-point only
    with pytest.raises(InputError, match="the law 'mpc' is not there in C"):
        export(load(written(tmp_path, text)), tmp_path / "export", controller="mpc")
    text = text.replace('["mpc"]', '["printed"]')
    with pytest.raises(InputError, match="the network is unstable"):
        export(load(written(tmp_path, text)), tmp_path / "export", controller="printed")


SUMMED = """
[[component]]
name = "shared"
fmu = "positive_agent"

[[connection]]
source = "agents.y[1]"
to = "shared.u[1]"
sum = true
"""


def test_without_an_ssp_file_the_rest_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "export"
    assert main(["export", str(written(tmp_path, TANH)), "--out", str(folder)]) == 0
    assert (folder / "paper-example-1-tanh.ssp").exists()
    capsys.readouterr()
    assert main(["export", str(written(tmp_path, TANH + SUMMED)), "--out", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "no SSP file: shared: the input 'u[1]' is a sum of 4 signals" in said
    assert not (folder / "paper-example-1-tanh.ssp").exists()  # not that of another time
    assert (folder / "controller-fmi3.fmu").exists()
    assert "There is no SSP file: shared" in (folder / "README.md").read_text()


def test_without_a_compiler_there_is_c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(compiling.shutil, "which", lambda *_: None)
    monkeypatch.setattr(compiling.importlib.util, "find_spec", lambda *_: None)
    arguments = ["export", str(written(tmp_path, TANH)), "--out", str(tmp_path / "export")]
    assert main([*arguments, "--platform", "x86_64-windows"]) == 3
    assert "found no C compiler for x86_64-windows" in capsys.readouterr().err
    assert not (tmp_path / "export").exists()
    assert main(arguments) == 0
    assert "no FMUs and no SSP file: found no C compiler" in capsys.readouterr().out
    assert (tmp_path / "export" / "c" / "agents.h").exists()


def test_elements_of_arrays_and_states_have_no_place_in_ssp(tmp_path: Path) -> None:
    agent = load("paper_example_1_tanh").agent
    arrays = agent_fmu(agent.g, agent.sec, agent.m, agent.p, agent.q, 3)  # type: ignore[arg-type]
    (tmp_path / "own.fmu").write_bytes(arrays.read_bytes())
    text = TANH.replace('fmu = "positive_agent"', 'fmu = "own.fmu"')
    text = text[: text.index("[initial]")]
    made = export(load(written(tmp_path, text)), tmp_path / "export")
    assert "own.fmu: 'u[1]' is an element of an array of FMI 3" in made.no_ssp
    text = TANH.replace('y1 = "y[1]"', 'y1 = "x[1]"')
    made = export(load(written(tmp_path, text)), tmp_path / "export")
    assert "'x[1]' is no output (its causality is local)" in made.no_ssp


def test_the_command_prints_what_it_wrote(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, folder = written(tmp_path, TANH), tmp_path / "export"
    arguments = ["export", str(path), "--out", str(folder), "--period", "0.01"]
    assert main([*arguments, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["certified"] == "yes"
    assert all(Path(file).exists() for file in told["files"])
    assert {Path(file).name for file in told["files"]} == {
        *("controller-fmi2.fmu", "controller-fmi3.fmu", "paper-example-1-tanh.ssp", "c"),
        *("agents.json", "design.json", "README.md"),
    }
    assert json.loads((folder / "agents.json").read_text())["period"] == 0.01
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "certified  yes" in said
    assert "that covers messages that take one period" in said
    assert main([*arguments, "--platform", "amiga"]) == 2
    assert "--platform: expected platforms from x86_64-linux" in capsys.readouterr().err
    twice = ["--platform", "aarch64-darwin", "--platform", "x86_64-darwin"]
    assert main([*arguments, *twice]) == 2
    assert "--platform: FMI 2 has one folder only" in capsys.readouterr().err


def test_an_agent_that_hears_nobody_but_the_leader(tmp_path: Path) -> None:
    one = network_from_arcs(1, [], [1])
    protocol = make_protocol(one, [[-1.0]], [[0.5]], phi=2.0)
    law = ProtocolLaw(linear_agent([[-1.0]], [[1.0]], [[1.0]]), protocol)
    made = Controllers(law, one.adjacency.indices, 0.1, np.zeros((1, 1)), np.ones(1))
    assert made.heard == 1
    assert made.weights(0)["weight"].tolist() == [0.0]


def test_python_functions_are_refused() -> None:
    agent = linear_agent([[-1.0]], [[1.0]], [[1.0]])
    own = attrs.evolve(agent, sec=lambda u: np.tanh(u))
    one = network_from_arcs(1, [], [1])
    law = ProtocolLaw(own, make_protocol(one, [[-1.0]], [[0.5]], phi=2.0))
    made = Controllers(law, one.adjacency.indices, 0.1, np.zeros((1, 1)), np.ones(1))
    with pytest.raises(InputError, match="Python functions"):
        made.files()
