"""The main job end to end: from scenario file to report, on real FMUs."""

import csv
import json

import attrs
import h5py
import numpy as np
import pytest
import xarray

from posmas_fmi import resources
from posmas_fmi.cosim.continuous import continuous
from posmas_fmi.errors import InputError, PosmasError
from posmas_fmi.protocol import make_protocol
from posmas_fmi.scenario import load, run
from posmas_fmi.scenario.plant import fmu_files

FILES = {"results.nc", "design.json", "manifest.json", "summary.json", "report.html"}


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """Each shipped scenario of the paper, run once."""
    folder = tmp_path_factory.mktemp("runs")
    return {
        name: run(load(name), folder / name)
        for name in (
            "paper_example_1",
            "paper_example_1_tanh",
            "paper_example_1_printed",
            "paper_example_2",
            "paper_example_2_printed",
        )
    }


def results(result):
    with xarray.open_dataset(result.folder / "results.nc", engine="h5netcdf") as data:
        return data.load()


def test_every_run_leaves_its_five_files(ran):
    for result in ran.values():
        assert {path.name for path in result.folder.iterdir()} == FILES
        summary = json.loads((result.folder / "summary.json").read_text())
        assert summary == result.summary
        design = json.loads((result.folder / "design.json").read_text())
        assert {"method", "K", "E", "certified", "assumptions", "rate", "observer_rate"} <= set(
            design
        )
        assert {"positive", "pinned", "p_max", "period", "conditions"} <= set(design)


def test_example_1_reaches_the_leader(ran):
    result = ran["paper_example_1"]
    assert result.summary["verdict"] == "converged"
    assert result.summary["tracking_error_final"] < 1e-3
    assert result.summary["min_state"] >= 0
    assert result.good
    certificate = result.design.certificate
    assert certificate.certified == "conditional"
    open_ = {a.name: a for a in certificate.assumptions if a.status != "verified"}
    assert list(open_) == ["lipschitz"]
    assert open_["lipschitz"].status == "contradicted"
    assert "1.0 declared" in open_["lipschitz"].detail
    data = results(result)
    assert float(data.x.min()) >= 0
    assert float(abs(data.x - data.s).isel(time=-1).max()) < 1e-3


def test_the_tanh_variant_is_certified_without_condition(ran):
    result = ran["paper_example_1_tanh"]
    assert result.design.certificate.certified == "yes"
    assert result.design.certificate.positive
    assert result.good


def test_the_printed_example_1_is_reported_as_diverged(ran):
    result = ran["paper_example_1_printed"]
    assert result.summary["verdict"] == "diverged"
    assert result.design.certificate.certified == "no"
    assert not result.good
    assert "agent" in result.summary["reason"]
    data = results(result)
    assert float(data.x.min()) < -1e3
    assert data.attrs["complete"] == 0


def test_example_2_stays_non_negative_with_the_designed_gains(ran):
    result = ran["paper_example_2"]
    assert result.good
    assert result.summary["min_state"] >= 0


def test_the_printed_example_2_loses_positivity(ran):
    result = ran["paper_example_2_printed"]
    assert result.summary["verdict"] == "positivity lost"
    assert not result.good


@pytest.mark.parametrize("gains", ["printed", "designed"])
def test_erratum_5_on_the_fmus(ran, tmp_path, gains):
    """The printed gain of Example 2 breaks positivity also with the corrected sign."""
    scenario = load("paper_example_2_printed", period=0.001, until=0.5)
    scenario = attrs.evolve(scenario, xhat0=scenario.x0, s0=np.zeros(2), baseline=False)
    if gains == "printed":
        design = attrs.evolve(scenario.design, protocol="corrected")
    else:
        design = load("paper_example_2").design
    result = run(attrs.evolve(scenario, design=design), tmp_path / gains, report=False)
    if gains == "printed":
        assert result.summary["min_state"] == pytest.approx(-0.40, abs=0.01)
    else:
        assert result.summary["min_state"] >= 0


def test_a_rerun_gives_the_same_results_bit_for_bit(ran, tmp_path):
    first = ran["paper_example_1"].folder
    again = run(load("paper_example_1"), tmp_path / "again", report=False).folder
    assert (first / "results.nc").read_bytes() == (again / "results.nc").read_bytes()
    assert (first / "design.json").read_bytes() == (again / "design.json").read_bytes()
    other = run(load("paper_example_1", seed=2, until=0.5), tmp_path / "other", report=False).folder
    assert (first / "results.nc").read_bytes() != (other / "results.nc").read_bytes()


def test_results_have_the_variables_of_the_contract(ran):
    data = results(ran["paper_example_1"])
    assert dict(data.sizes) == {
        "time": 2001, "agent": 4, "state": 2, "input": 1, "output": 2, "arc": 6
    }  # fmt: skip
    for name, dimensions in {
        "x": ("time", "agent", "state"),
        "xhat": ("time", "agent", "state"),
        "u": ("time", "agent", "input"),
        "y": ("time", "agent", "output"),
        "s": ("time", "state"),
    }.items():
        assert data[name].dims == dimensions
        assert bool(np.isfinite(data[name]).all())
    np.testing.assert_allclose(data.y.values, data.x.values @ load("paper_example_1").agent.C.T)
    assert data.time[-1] == 10.0
    assert list(data.agent.values) == ["1", "2", "3", "4"]


def test_both_fmi_versions_give_the_same_run(tmp_path):
    scenario = load("paper_example_1", until=1.0)
    seen = []
    for fmi in (2, 3):
        plant = attrs.evolve(scenario.plant, fmi=fmi)
        seen.append(
            results(run(attrs.evolve(scenario, plant=plant), tmp_path / str(fmi), report=False))
        )
    np.testing.assert_array_equal(seen[0].x, seen[1].x)


def test_the_fmus_follow_the_continuous_protocol_with_first_order(tmp_path):
    errors = []
    for h in (0.01, 0.005, 0.0025):
        scenario = attrs.evolve(load("paper_example_1", period=h, until=1.0), baseline=False)
        design = attrs.evolve(
            scenario.design, method="gains", K=[[-0.441, -0.441]], E=[[0.0, 9.0], [0.0, 9.0]]
        )
        result = run(attrs.evolve(scenario, design=design), tmp_path / str(h), report=False)
        oracle = continuous(
            scenario.agent,
            scenario.network,
            make_protocol(scenario.network, design.K, design.E, design.phi),
            scenario.x0,
            scenario.xhat0,
            scenario.s0,
            np.array([0.0, 1.0]),
        )
        errors.append(float(np.abs(results(result).x[-1] - oracle["x"][-1]).max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders[-1] > 0.9, (errors, orders)


def test_a_single_agent_is_a_network(tmp_path):
    text = (resources.shipped("models") / "paper_example_1_tanh.toml").read_text(encoding="utf-8")
    start, end = text.index("agents = 4"), text.index("pinned = [2]")
    text = text[:start] + "agents = 1\narcs = []\n" + text[end:].replace("[2]", "[1]", 1)
    path = tmp_path / "one.toml"
    path.write_text(text, encoding="utf-8")
    result = run(load(str(path)), tmp_path / "out")
    assert result.good
    assert result.design.certificate.certified == "yes"


def test_the_run_works_by_path_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = resources.shipped("models") / "paper_example_1.toml"
    result = run(load(str(path), until=0.1), tmp_path / "out")
    assert result.summary["steps"] == 20


def changed(tmp_path, old, new):
    text = (resources.shipped("models") / "paper_example_1.toml").read_text(encoding="utf-8")
    assert old in text
    text = text.replace(old, new, 1)
    if '"positive_agent"' not in text:  # other FMUs start from their own start values
        text = text.replace("x = {uniform = [0.0, 2.0]}", "")
    path = tmp_path / "case.toml"
    path.write_text(text, encoding="utf-8")
    return load(str(path), until=0.1)


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ('y1 = "y[1]"', 'y1 = "z[1]"', "$.plant.outputs"),
        ('u1 = "u[1]"', 'u1 = "u[2]"', "$.plant.inputs"),
        ('u1 = "u[1]"', 'v1 = "u[1]"', "$.plant.inputs"),
        ('y1 = "y[1]", ', "", "$.plant.outputs.y1"),
        ('u1 = "u[1]"', 'u1 = {variable = "u[1]", unit = "kg"}', "$.plant.inputs"),
        ('u1 = "u[1]"', 'u1 = {variable = "u[1]", scale = 0.0}', "$.plant.inputs.u1.scale"),
        ('"positive_agent"', '"missing.fmu"', "$.plant.fmu"),
        (
            "[leader]",
            '[[plant.override]]\nagent = 2\nfmu = "missing.fmu"\n[leader]',
            "$.plant.override[0].fmu",
        ),
        ("[leader]", "[plant.parameters]\nQ = 1.0\n[leader]", "$.plant.parameters"),
    ],
)
def test_plants_that_do_not_fit_are_input_errors(tmp_path, old, new, place):
    with pytest.raises(PosmasError) as caught:
        run(changed(tmp_path, old, new), tmp_path / "out")
    assert place in str(caught.value)
    assert caught.value.exit_code == 2


def test_every_shipped_plant_can_be_named(tmp_path):
    """It is found, prebuilt or built; which of its variables are meant must be said."""
    scenario = changed(tmp_path, '"positive_agent"', '"cooling_line"')
    assert fmu_files(scenario)[0].name.startswith("cooling_line-fmi3-")
    with pytest.raises(PosmasError, match=r"cooling_line.*there is no variable 'u\[1\]'"):
        run(scenario, tmp_path / "out")


@pytest.mark.parametrize("recorded", ["", "[record]\nvariables = []\n"])
def test_an_fmu_of_ones_own_needs_to_show_no_states(tmp_path, recorded):
    """As the README says it: inputs and outputs are enough, all else at its defaults."""
    shipped = fmu_files(load("paper_example_1"))[0]
    (tmp_path / "mine.fmu").write_bytes(shipped.read_bytes())
    scenario = changed(tmp_path, '"positive_agent"', '"mine.fmu"')
    if recorded:
        path = tmp_path / "case.toml"
        path.write_text(path.read_text(encoding="utf-8") + recorded, encoding="utf-8")
        scenario = load(str(path), until=0.1)
    assert scenario.baseline
    result = run(scenario, tmp_path / "out", report=not recorded)
    assert result.summary["steps"] == 20
    data = results(result)
    assert len(data.time) == 21
    if not recorded:
        assert np.isfinite(data.y).all()
        assert (result.folder / "report.html").exists()


def test_what_is_no_fmu_is_an_fmu_error(tmp_path):
    (tmp_path / "plant.fmu").write_bytes(b"no archive")
    with pytest.raises(PosmasError) as caught:
        run(changed(tmp_path, '"positive_agent"', '"plant.fmu"'), tmp_path / "out")
    assert "plant.fmu" in str(caught.value)
    assert caught.value.exit_code == 3


def test_scale_and_offset_at_the_ports(tmp_path):
    """An FMU whose output is scaled behaves as the plain one once the port undoes it."""
    plain = run(changed(tmp_path, "[leader]", "[leader]"), tmp_path / "plain", report=False)
    ports = (
        'outputs.y1 = {variable = "y[1]", scale = 10.0}\n'
        'outputs.y2 = {variable = "y[2]", scale = 0.5}\n'
        "[plant.parameters]\nC = [[7.0, -3.0], [0.05, 0.3]]\n"
    )
    scaled = run(
        changed(tmp_path, 'outputs = {y1 = "y[1]", y2 = "y[2]"}\n', ports),
        tmp_path / "scaled",
        report=False,
    )
    np.testing.assert_allclose(results(scaled).y, results(plain).y, rtol=1e-12, atol=1e-12)


def test_an_output_folder_that_cannot_be_is_an_input_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="output folder"):
        run(load("paper_example_1", until=0.1), tmp_path / "file" / "out")


def test_the_manifest_makes_the_run_repeatable(ran):
    manifest = json.loads((ran["paper_example_1"].folder / "manifest.json").read_text())
    assert manifest["seed"] == 1
    assert "sin(0.31*x1*t)" in manifest["scenario"]
    assert all(len(value) == 64 for value in manifest["fmus"].values())
    assert set(manifest["versions"]) >= {"posmas-fmi", "numpy", "fmpy"}


def test_without_control_is_recorded_beside_the_run(ran):
    data = results(ran["paper_example_1"])
    assert data.x_baseline.dims == ("time", "agent", "state")
    assert bool(np.isfinite(data.x_baseline).all())
    error = abs(data.x - data.s).max(("agent", "state"))
    alone = abs(data.x_baseline - data.s).max(("agent", "state"))
    assert float(error.sel(time=1.0)) < 0.5 * float(alone.sel(time=1.0))


def test_results_are_readable_while_they_are_written(tmp_path):
    """What is held in memory is bounded: a crash loses the last of it at most."""
    from posmas_fmi.cosim.recorder import CHUNK, Layout, Recorder
    from posmas_fmi.netcdf import recorded
    from posmas_fmi.network import network_from_arcs

    network = network_from_arcs(1, [], [1])
    layout = Layout(("1",), ("x1",), ("u1",), ("y1",))
    recorder = Recorder(tmp_path / "r.nc", layout, network, ("u",), {})
    for k in range(2 * CHUNK + 3):  # the second chunk waits until the first one is written
        recorder.record(float(k), {"u": np.array([[k]])})
    copy = tmp_path / "copy.nc"
    copy.write_bytes((tmp_path / "r.nc").read_bytes())
    with h5py.File(copy) as file:
        assert recorded(file["time"][:]) >= CHUNK
        assert file["u"][CHUNK - 1, 0, 0] == CHUNK - 1
    recorder.close()
    with h5py.File(tmp_path / "r.nc") as file:
        assert file["time"].shape == (2 * CHUNK + 3,)
        assert (file["u"][:, 0, 0] == np.arange(2 * CHUNK + 3)).all()
        assert file.attrs["complete"] == 0


def test_what_is_recorded_can_be_chosen_and_thinned(tmp_path):
    from posmas_fmi.scenario.tables import RecordTable

    scenario = load("paper_example_1", until=1.005)  # 201 steps
    whole = results(run(scenario, tmp_path / "whole", report=False))
    table = RecordTable(every=10, variables=["x", "s"], csv=True)
    thin = run(attrs.evolve(scenario, record=table), tmp_path / "thin")
    kept = results(thin)
    points = [*range(0, 201, 10), 201]
    assert not {"xhat", "u", "sec_u", "y"} & set(kept.variables)
    for name in ("time", "x", "s", "x_baseline"):
        np.testing.assert_array_equal(kept[name], whole[name][points])
    assert not (thin.folder / "report.html").exists()
    with (thin.folder / "results.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header[:3] == ["time", "s.x1", "s.x2"]
    column = header.index("x.3.x2")
    assert [float(row[column]) for row in rows] == kept["x"][:, 2, 1].values.tolist()


def test_the_recorder_writes_before_it_holds_much(tmp_path, monkeypatch):
    from posmas_fmi.cosim import recorder
    from posmas_fmi.netcdf import recorded
    from posmas_fmi.network import network_from_arcs

    monkeypatch.setattr(recorder, "HELD", 10 * 8 * 200)
    agents = tuple(str(k) for k in range(100))
    layout = recorder.Layout(agents, ("x1", "x2"), ("u1",), ("y1",))
    network = network_from_arcs(100, [], [1])
    with recorder.Recorder(tmp_path / "r.nc", layout, network, ("x",), {}) as one:
        for k in range(25):
            one.record(float(k), {"x": np.full((100, 2), k)})
        with h5py.File(tmp_path / "r.nc", "r") as file:
            assert recorded(file["time"][:]) in (10, 20)  # or 20 are being written
        one.flush()
        with h5py.File(tmp_path / "r.nc", "r") as file:
            assert recorded(file["time"][:]) == 25
