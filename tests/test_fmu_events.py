"""Event Mode, clocks, and Model Exchange FMUs that take communication steps."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import test_engine
import xarray
from fmu_examples import example_1, named, tank_fmu, vector
from fmu_scenarios import one_fmu
from test_fmu_instance import described

from posmas_fmi import load, run
from posmas_fmi.cosim.fmu_plant import FmuPlant, PlantSpec, PortMap
from posmas_fmi.cosim.snapshot import Snapshot
from posmas_fmi.errors import FmuCallError, FmuError
from posmas_fmi.fmu.about import read_about
from posmas_fmi.fmu.archive import read_entry
from posmas_fmi.fmu.check.preflight import check_fmu
from posmas_fmi.fmu.clocks import read_clocks
from posmas_fmi.fmu.compile import host, shared_library
from posmas_fmi.fmu.event_mode import EventFile, EventInstance
from posmas_fmi.fmu.open import open_fmu
from posmas_fmi.fmu.period import check_period
from posmas_fmi.fmu.stepped import SteppedInstance

CLOCKED = Path(__file__).parent / "clocked"


def packed(folder: Path, code: str, description: Path = CLOCKED) -> Path:
    """Make an FMU of this C code, with the description in a folder."""
    target = host()
    library = shared_library({"model.c": code}, ["model.c"], "clocked", target)
    path = folder / "clocked.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(description / "modelDescription.xml", "modelDescription.xml")
        archive.writestr(f"binaries/{target.name}/clocked{target.extension}", library)
    return path


@pytest.fixture(scope="module")
def clocked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packed(tmp_path_factory.mktemp("clocked"), (CLOCKED / "model.c").read_text())


@pytest.fixture
def sampler(clocked: Path) -> Iterator[EventInstance]:
    with open_fmu(clocked) as file:
        assert isinstance(file, EventFile)
        with file.instantiate("s") as instance:
            instance.initialise({"gain": 2.0}, stop=10.0)
            yield instance


def test_check_tries_clocks_in_event_mode(tmp_path: Path) -> None:
    """Some FMUs do not start without it (found on one that is public)."""
    code = (CLOCKED / "model.c").read_text()
    begin = "    Sampler *s = calloc(1, sizeof *s);\n"
    strict = code.replace(begin, f"    if (!events)\n        return NULL;\n{begin}")
    assert strict != code
    made = check_fmu(packed(tmp_path, strict), control=False)
    assert "no-instance" not in [finding.code for finding in made.findings]
    assert made.results["steps"] > 10


def test_clocks_are_read_from_the_description(clocked: Path) -> None:
    tick, alarm = read_clocks(read_entry(clocked, "modelDescription.xml"))
    assert (tick.name, tick.reference, tick.tick(3)) == ("tick", 20, 0.6)
    assert (alarm.name, alarm.periodic, alarm.asked) == ("alarm", False, True)
    counted = b'<A><Clock name="c" valueReference="1" causality="input" intervalVariability="fixed"'
    counted += b' intervalCounter="3" shiftCounter="1" resolution="10"/></A>'
    assert read_clocks(counted)[0].tick(1) == 0.4


def test_clocked_inputs_are_taken_at_the_ticks(sampler: EventInstance) -> None:
    """The clock ticks at 0, 0.2, 0.4; what u is in between does not count."""
    u, seen = sampler.file.ports(("u",)), []
    for k in range(5):
        sampler.write(u, [k + 1.0])
        sampler.do_step(0.1 * k, 0.1)
        seen.append(sampler.get("y"))
    assert seen == [2.0, 2.0, 8.0, 8.0, 18.0]  # 2·1, then 2·3, then 2·5
    assert sampler.time == pytest.approx(0.5)


def test_time_events_and_countdowns_between_the_points(sampler: EventInstance) -> None:
    """y jumps by 10 at 0.55, within a step; the alarm rings 0.15 s later, within the next one."""
    x = 0.0
    sampler.do_step(0.0, 0.6)
    x = 10.0 * (1 - np.exp(-0.05))
    assert (sampler.get("jumps"), sampler.get("alarms"), sampler.get("y")) == (1, 0, 10.0)
    assert sampler.get("x") == pytest.approx(x, rel=1e-12)
    sampler.do_step(0.6, 0.2)
    assert sampler.get("alarms") == 1
    assert sampler.get("x") == pytest.approx(10.0 + (x - 10.0) * np.exp(-0.2), rel=1e-12)


def test_discrete_inputs_are_set_in_event_mode_when_they_change(sampler: EventInstance) -> None:
    level = sampler.file.ports(("level",))
    for value in (3, 3, 4):
        sampler.write(level, [value])
        sampler.do_step(sampler.time, 0.1)
        assert sampler.get("level") == value


def test_going_back_takes_the_clocks_along(sampler: EventInstance) -> None:
    u = sampler.file.ports(("u",))
    sampler.write(u, [1.0])
    sampler.do_step(0.0, 0.1)
    state, found = sampler.get_state(), []
    for _ in range(2):
        sampler.set_state(state)
        sampler.write(u, [5.0])
        sampler.do_step(0.1, 0.3)
        sampler.do_step(0.4, 0.5)
        found.append([sampler.get(name) for name in ("y", "x", "jumps", "alarms")])
    assert found[0] == found[1]
    assert found[0][0] == 2.0 + 10.0 + 2 * 5.0 * 4  # ticks at 0.2, 0.4, 0.6 and 0.8


def test_a_serialised_state_takes_the_clocks_along(sampler: EventInstance) -> None:
    """Clocks, waiting inputs and the alarm that is set go on in a fresh instance."""
    u, level = (sampler.file.ports((name,)) for name in ("u", "level"))
    sampler.write(level, [3])
    sampler.write(u, [1.0])
    sampler.do_step(0.0, 0.6)  # the alarm is set at 0.55 and rings at 0.7
    sampler.write(u, [5.0])  # waits for the tick at 0.6
    data = sampler.serialise()
    with sampler.file.instantiate("fresh") as fresh:
        fresh.initialise({"gain": 1.0}, stop=10.0)
        fresh.deserialise(data, 0.6)
        found = []
        for one in (sampler, fresh):
            one.do_step(0.6, 0.3)
            found.append([one.get(name) for name in ("y", "x", "jumps", "alarms", "level")])
    assert found[0] == found[1]
    assert found[0][3:] == [1, 3]


def test_a_tick_between_points_of_an_fmu_with_equal_steps(clocked: Path, tmp_path: Path) -> None:
    old = b'canHandleVariableCommunicationStepSize="true"'
    equal = described(clocked, tmp_path / "equal.fmu", old, b"")
    with open_fmu(equal) as file, file.instantiate("s") as instance:
        assert [check_period(file, h).allowed for h in (0.1, 0.2, 0.05, 0.15, 0.4)] == [
            *(True, True, True, False, False)
        ]
        assert [check_period(file, h).nearest for h in (0.15, 0.4, 0.11)] == [0.2, 0.2, 0.1]
        instance.initialise()
        instance.do_step(0.0, 0.15)
        instance.do_step(0.15, 0.15)
        with pytest.raises(FmuCallError, match=r"'tick' ticks at 0\.2 s, between two"):
            instance.do_step(0.3, 0.15)


@pytest.mark.parametrize("reached", ["NAN", "t - 1", "t + 2 * h", "t"])
def test_an_early_return_at_no_time_of_the_step(tmp_path: Path, reached: str) -> None:
    """In a scenario, so that the failure can be written down as well."""
    code = (CLOCKED / "model.c").read_text()
    old = "*reached = *early ? s->event_at : end;"
    path = packed(tmp_path, code.replace(old, f"*early = true, *reached = {reached};"))
    file = one_fmu(tmp_path, path, '"u"', '"y"', 'isolation = "none"')
    summary = run(load(file), tmp_path / "out", report=False).summary
    assert summary["verdict"] == "failed"
    assert "fmi3DoStep: returned early at" in summary["reason"]


@pytest.mark.parametrize("most", [0.03, 0.013])
def test_a_step_that_returns_early_each_time(clocked: Path, tmp_path: Path, most: float) -> None:
    code = (CLOCKED / "model.c").read_text()
    old = "const double end = t + h;"
    code = code.replace(old, f"const double whole = t + h, end = t + fmin(h, {most});")
    code = code.replace("*early = *event && s->early", "*early = end < whole || *event && s->early")
    code = code.replace("*early ? s->event_at : end", "*event ? fmin(s->event_at, end) : end")
    found = []
    for path in (clocked, packed(tmp_path, code)):
        with open_fmu(path) as file, file.instantiate("s") as instance:
            instance.initialise({"gain": 2.0}, stop=10.0)
            for k in range(10):
                instance.write(file.ports(("u",)), [k + 1.0])
                instance.do_step(0.1 * k, 0.1)
            found.append([instance.get(name) for name in ("y", "x", "jumps", "alarms")])
    assert found[1] == pytest.approx(found[0], rel=1e-12)


def test_without_event_mode_it_is_refused(clocked: Path, tmp_path: Path) -> None:
    with pytest.raises(FmuError, match="hasEventMode"):
        EventFile(described(clocked, tmp_path / "x.fmu", b'hasEventMode="true"', b""))


@pytest.mark.parametrize("engine", ["c", "numpy"])
def test_clocks_in_a_scenario(clocked: Path, tmp_path: Path, engine: str) -> None:
    more = 'parameters = {gain = 2.0}\nrecord = ["jumps", "alarms"]'
    path = one_fmu(tmp_path, clocked, '"u"', '"y"', more, engine=engine, gain=-0.05)
    run(load(path), tmp_path / "out", report=False)
    with xarray.open_dataset(tmp_path / "out" / "results.nc") as data:
        u, y = data["u"].values[..., 0], data["y"].values[..., 0]
        assert data["jumps"].values[-1].tolist() == [1, 1]
        assert data["alarms"].values[-1].tolist() == [1, 1]
    ticks = np.cumsum(np.where(np.arange(10)[:, None] % 2 == 0, 2.0 * u[:-1], 0.0), axis=0)
    jump = np.where(np.arange(1, 11)[:, None] >= 6, 10.0, 0.0)
    np.testing.assert_allclose(y[1:], ticks + jump, rtol=1e-12, atol=1e-12)
    assert np.ptp(u) > 0.05


# ---- Model Exchange ------------------------------------------------------------------------------


def only_me(path: Path, to: Path) -> Path:
    """The same FMU without its Co-Simulation interface."""
    text = read_entry(path, "modelDescription.xml")
    begin = text.index(b"<CoSimulation")
    end = text.index(b">", begin) + 1
    if text[end - 2 : end] != b"/>":
        end = text.index(b"</CoSimulation>") + len(b"</CoSimulation>")
    return described(path, to, text[begin:end], b"")


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_model_takes_steps_like_its_co_simulation_fmu(tmp_path: Path, fmi: int) -> None:
    example, found = example_1(), []
    path = example.fmu(fmi, tmp_path)
    for one in (path, only_me(path, tmp_path / "me.fmu")):
        with open_fmu(one) as file, file.instantiate("a") as instance:
            assert isinstance(instance, SteppedInstance) == (one != path)
            instance.initialise(
                named({**example.matrices, "x": [1.0, 0.3]}, fmi), stop=1.0, tolerance=1e-10
            )
            u, x = file.ports(vector("u", 1)), file.ports(vector("x", 2))
            rows = []
            for k in range(10):
                instance.write(u, [np.sin(k)])
                instance.do_step(0.05 * k, 0.05)
                rows.append(instance.read(x))
            assert instance.time == pytest.approx(0.5)
            found.append(rows)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6, atol=1e-8)


def test_check_sets_discrete_inputs_of_a_model_in_event_mode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Feedthrough of the Reference FMUs refuses them in Continuous-Time Mode, as it may."""
    old = "return c ? (fmi2Status)instance_set(INSTANCE(c), vr, nvr, value, nvr) : fmi2Error;"
    new = f"if (INSTANCE(c)->state.mode == MODE_CONTINUOUS)\n        return fmi2Error;\n    {old}"
    test_engine.changed(monkeypatch, 2, old, new)
    path = only_me(tank_fmu(tmp_path, 2), tmp_path / "me.fmu")
    text = read_entry(path, "modelDescription.xml")
    power = re.search(rb'name="power"[^>]*>', text)
    assert power is not None
    new = power.group().replace(b"continuous", b"discrete")
    path = described(path, tmp_path / "strict.fmu", power.group(), new)
    made = check_fmu(path)
    assert made.results["steps"] > 10
    assert not [f for f in made.findings if f.code == "status-error"]


@pytest.mark.parametrize("nominal", ["0", "-300"])
def test_nominal_values_that_are_no_sizes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, nominal: str
) -> None:
    """Public FMUs of Dymola say 0: with that as absolute tolerance no integration begins."""
    old = "return c ? (fmi2Status)instance_get_nominals(INSTANCE(c), x_nominal, nx) : fmi2Error;"
    new = f"x_nominal[0] = {nominal};\n    return c && nx == 1 ? fmi2OK : fmi2Error;"
    test_engine.changed(monkeypatch, 2, old, new)
    path = only_me(tank_fmu(tmp_path, 2), tmp_path / "me.fmu")
    with open_fmu(path) as file, file.instantiate("a") as instance:
        instance.initialise({"temperature": 0.0, "power": 0.0})
        instance.do_step(0.0, 25.0)
        assert instance.get("temperature") == pytest.approx(290.0 * (1 - np.exp(-1.0)), rel=1e-5)


@pytest.mark.parametrize("engine", ["c", "numpy"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_models_in_a_scenario(tmp_path: Path, engine: str, fmi: int) -> None:
    path, found = tank_fmu(tmp_path, fmi), []
    for one in (path, only_me(path, tmp_path / "me.fmu")):
        power = '{variable = "power", scale = 100.0, offset = 50.0}'
        temperature = '{variable = "temperature", offset = 290.0}'
        file = one_fmu(tmp_path, one, power, temperature, engine=engine, gain=-0.3)
        run(load(file), tmp_path / "out", report=False)
        with xarray.open_dataset(tmp_path / "out" / "results.nc") as data:
            found.append((data["u"].values, data["y"].values))
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-6)
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=1e-5, atol=1e-7)
    assert np.ptp(found[0][1]) > 0.1


def test_a_model_goes_back(tmp_path: Path) -> None:
    path = only_me(tank_fmu(tmp_path, 3), tmp_path / "me.fmu")
    ports = PortMap.plain(("power",)), PortMap.plain(("temperature",))
    with FmuPlant([PlantSpec(path, {}, "a", *ports)], False, 10.0) as plant:
        which, found = np.arange(1), []
        saved = plant.save(which)
        for _ in range(2):
            plant.restore(saved)
            readings = np.zeros(1)
            plant.step(which, np.zeros(1), np.ones(1), np.array([300.0]), readings)
            plant.read(which, 1.0, readings)
            found.append(readings[0])
    assert found[0] == found[1] > 300.0


@pytest.mark.parametrize("isolation", ["none", "process"])
@pytest.mark.parametrize("kind", ["clocked", "model"])
def test_a_run_with_them_goes_on_from_a_snapshot(
    clocked: Path, tmp_path: Path, kind: str, isolation: str
) -> None:
    """What the FMU cannot know is in the snapshot: bit for bit the same, without doing it again."""
    path = clocked if kind == "clocked" else only_me(tank_fmu(tmp_path, 3), tmp_path / "me.fmu")
    ports = ('"u"', '"y"') if kind == "clocked" else ('"power"', '"temperature"')
    more = f'isolation = "{isolation}"'
    text = Path(one_fmu(tmp_path, path, *ports, more, gain=-0.05))
    text.write_text(text.read_text().replace("[scenario]", "[scenario]\nsnapshot = 0.3", 1))
    run(load(text), tmp_path / "whole", report=False)
    kept = sorted((tmp_path / "whole" / "snapshots").glob("*.npz"))
    assert all(Snapshot.load(one).fmus is not None for one in kept)
    with xarray.open_dataset(tmp_path / "whole" / "results.nc") as data:
        expected = data.load()
    for begin in (3, 6):
        branch = (tmp_path / "whole", begin / 10)
        run(load(text), tmp_path / f"from-{begin}", report=False, branch=branch)
        with xarray.open_dataset(tmp_path / f"from-{begin}" / "results.nc") as data:
            for name in ("time", "y", "u", "xhat"):
                np.testing.assert_array_equal(data[name].values, expected[name].values[begin:])


def test_events_of_a_model_on_and_between_the_points(tmp_path: Path) -> None:
    """x' = 1 + u falls from 1 to 0, which falls between the points; the clock ticks on them."""
    folder = Path(__file__).parent / "sawtooth"
    path = packed(tmp_path, (folder / "model.c").read_text(), folder)
    with open_fmu(path) as file, file.instantiate("s") as instance:
        assert isinstance(instance, SteppedInstance)
        instance.initialise({}, stop=3.0)
        for k in range(30):  # 0.1·k is above 0.5, 1, … by rounding at times, at times below
            instance.write(file.ports(("u",)), [0.27])
            instance.do_step(0.1 * k, 0.1)
            t = (k + 1) / 10
            assert instance.get("clock") == t // 0.5, t
            way = 1.27 * t
            assert instance.get("falls") == way // 1, t
            assert instance.get("x") == pytest.approx(way - way // 1, abs=1e-7)
    with open_fmu(path) as file, file.instantiate("s") as instance:
        instance.initialise({}, stop=3.0)
        instance.write(file.ports(("u",)), [0.2])
        instance.do_step(0.0, 3.0)  # many events in one step, and one at its end
        assert [instance.get(name) for name in ("clock", "falls")] == [6.0, 3.0]


def test_what_is_scheduled_only_is_not_run(tmp_path: Path) -> None:
    path = only_me(tank_fmu(tmp_path, 3), tmp_path / "me.fmu")
    neither = described(path, tmp_path / "s.fmu", b"<ModelExchange", b"<ScheduledExecution")
    assert read_about(neither).interface is None
    with pytest.raises(FmuError, match="Scheduled Execution only"):
        open_fmu(neither)
