"""Limits, key figures, loads and sensors of a cooling row."""

from __future__ import annotations

import gzip
from pathlib import Path

import attrs
import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from posmas_fmi.cooling import (
    LoadModel,
    Loads,
    Sensor,
    Training,
    class_limit,
    class_of,
    dew_point,
    exceedance,
    generate_loads,
    key_figures,
    rainflow,
    read_loads,
    settling_time,
    thermal_cycles,
    training_loads,
)
from posmas_fmi.errors import InputError

FRONTIER = Path(__file__).resolve().parents[2] / "shared" / "data" / "frontier_day.csv.gz"

# ---- limits -------------------------------------------------------------------------------------


def test_the_water_classes() -> None:
    assert [class_limit(f"W{t}") for t in (17, 27, 32, 40, 45)] == [
        t + 273.15 for t in (17, 27, 32, 40, 45)
    ]
    assert [class_of(t + 273.15) for t in (5, 17, 17.1, 45)] == ["W17", "W17", "W27", "W45"]
    with pytest.raises(InputError, match="above W45"):
        class_of(319.0)
    with pytest.raises(InputError, match="W17, W27"):
        class_limit("W99")


@pytest.mark.parametrize(
    ("celsius", "humidity", "dew"),
    [(25.0, 0.50, 13.86), (20.0, 0.60, 12.01), (35.0, 0.80, 31.02), (30.0, 1.0, 30.0)],
)
def test_the_dew_point(celsius: float, humidity: float, dew: float) -> None:
    # psychrometric tables
    assert float(dew_point(celsius + 273.15, humidity)) - 273.15 == pytest.approx(dew, abs=0.02)


@given(st.floats(240.0, 330.0), st.floats(0.01, 1.0))
def test_air_is_never_colder_than_its_dew_point(temperature: float, humidity: float) -> None:
    assert float(dew_point(temperature, humidity)) <= temperature + 1e-9


@pytest.mark.parametrize(("temperature", "humidity"), [(25.0, 0.5), (300.0, 0.0), (300.0, 50.0)])
def test_celsius_and_percent_are_refused(temperature: float, humidity: float) -> None:
    with pytest.raises(InputError):
        dew_point(temperature, humidity)


@given(st.lists(st.floats(-5, 5), min_size=2, max_size=20), st.floats(-3, 3))
def test_exceedance_is_the_integral(values: list[float], limit: float) -> None:
    time = np.arange(len(values)) * 2.0
    fine = np.linspace(0, time[-1], 20_001)
    over = np.maximum(np.interp(fine, time, values) - limit, 0)
    expected = float(np.sum((over[1:] + over[:-1]) / 2 * np.diff(fine)))
    assert float(exceedance(time, values, limit)) == pytest.approx(expected, abs=1e-2)


# ---- key figures --------------------------------------------------------------------------------


def test_rainflow_counts_as_the_standard_does() -> None:
    # ASTM E1049-85, figure 6
    cycles = rainflow([-2, 1, -3, 5, -1, 3, -4, 4, -2])
    counted = {r: cycles[cycles[:, 0] == r, 2].sum() for r in np.unique(cycles[:, 0])}
    assert counted == {3.0: 0.5, 4.0: 1.5, 6.0: 0.5, 8.0: 1.0, 9.0: 0.5}


@given(st.lists(st.integers(-9, 9), min_size=1, max_size=40))
def test_rainflow_loses_no_reversal(values: list[int]) -> None:
    moving = [v for k, v in enumerate(values) if k == 0 or v != values[k - 1]]
    turns = sum(
        (b - a) * (c - b) < 0 for a, b, c in zip(moving, moving[1:], moving[2:], strict=False)
    )
    half_cycles = 2 * rainflow(values)[:, 2].sum() if len(moving) > 1 else 0
    assert half_cycles == (turns + 1 if len(moving) > 1 else 0)


def test_small_swings_are_no_thermal_cycles() -> None:
    time = np.linspace(0, 10, 2001)
    case = 330 + 5 * np.sin(2 * np.pi * time) + 0.5 * np.sin(40 * np.pi * time)
    assert thermal_cycles(case) == pytest.approx(10, abs=0.5)
    assert thermal_cycles(case, least=20) == 0


def run() -> dict[str, np.ndarray]:
    """Two lines: one with a decaying deviation, one that stays where it should."""
    time = np.linspace(0, 7200, 7201)
    supply = np.column_stack([310.15 + 4 * np.exp(-time / 600), np.full(time.shape, 310.15)])
    valve = np.column_stack([0.5 + 0.5 * np.sin(2 * np.pi * time / 3600), np.full(7201, 0.7)])
    return {"time": time, "supply": supply, "valve": valve, "case": supply + 22}


def test_the_key_figures_of_a_known_run() -> None:
    figures = key_figures(
        **run(), set_point=310.15, facility=305.15, class_limit=class_limit("W32"), messages=400
    )
    assert figures.worst == figures.over == pytest.approx(4.0)
    assert figures.spread == pytest.approx(4.0)
    assert figures.spread_end == pytest.approx(0.0, abs=1e-4)
    assert figures.rms_by_line == pytest.approx([np.sqrt(16 * 300 / 7200), 0], abs=1e-4)
    assert figures.rms == pytest.approx(figures.rms_by_line[0] / np.sqrt(2))
    settles = 600 * np.log(4)
    assert figures.settling == pytest.approx(settles, abs=1)
    assert figures.exceedance_band == pytest.approx(600 * 3 - settles, rel=1e-4)
    assert figures.exceedance_class == 0
    assert figures.strokes_per_hour == pytest.approx((2 + 0) / 2)  # up, down, and a line at rest
    assert figures.cycles_per_hour == pytest.approx(0.5 / 2 / 2)  # one half cycle in two hours
    assert figures.hottest_case == pytest.approx(336.15)
    assert figures.messages_per_hour == 200
    assert figures.lowest == pytest.approx(5.0)
    assert figures.worst_line == 0
    assert figures.as_dict()["worst_line"] == 1


def test_key_figures_take_xarray_and_moving_set_points() -> None:
    data = run()
    supply = xr.DataArray(data["supply"], dims=("time", "agent"), coords={"time": data["time"]})
    set_point = xr.DataArray(data["supply"][:, 0], dims="time")
    figures = key_figures(supply.time, supply, set_point, facility=305.15)
    assert figures.rms_by_line[0] == 0
    assert figures.worst == pytest.approx(4.0)
    assert figures.strokes_per_hour is None
    assert figures.as_dict()["messages_per_hour"] is None


def test_a_run_that_does_not_settle() -> None:
    assert settling_time([0.0, 1.0], [0.0, 2.0], 1.0) == np.inf
    figures = key_figures([0.0, 60.0], [[312.0], [312.0]], 310.0, 305.0)
    assert figures.settling == np.inf
    assert figures.as_dict()["settling"] is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"supply": np.zeros((3, 2))}, "supply: expected shape"),
        ({"supply": np.full((2, 2), np.nan)}, "finite"),
        ({"valve": np.zeros((2, 3))}, "valve: expected shape"),
        ({"facility": np.zeros(3)}, "facility: expected a number"),
        ({"time": [0.0]}, "two times"),
    ],
)
def test_key_figures_of_what_does_not_fit(changes: dict[str, object], message: str) -> None:
    given = {"time": [0.0, 1.0], "supply": np.zeros((2, 2)), "set_point": 0.0, "facility": 0.0}
    with pytest.raises(InputError, match=message):
        key_figures(**(given | changes))  # type: ignore[arg-type]


# ---- generated loads ----------------------------------------------------------------------------


def autocorrelation(signal: np.ndarray, lag: int) -> float:
    centred = signal - signal.mean()
    return float((centred[lag:] * centred[:-lag]).mean() / (centred**2).mean())


@attrs.frozen
class Day:
    """Statistics of a day in steps of 15 s."""

    autocorrelation: tuple[float, ...]  # at 5 min, 20 min, 1 h
    between_lines: float
    low: float  # levels, of the load that is exceeded 1 % of the time
    high: float
    steepest: float  # per 15 s
    switches: int

    @classmethod
    def of(cls, power: np.ndarray) -> Day:
        total = power.sum(axis=1)
        relative = total / np.quantile(total, 0.99)  # the day's maximum is six short spikes
        upper = np.triu_indices(power.shape[1], 1)
        return cls(
            tuple(autocorrelation(total, lag) for lag in (20, 80, 240)),
            float(np.corrcoef(power.T)[upper].mean()),
            float(np.median(relative[relative < 0.6])),
            float(np.median(relative[relative > 0.6])),
            float(np.abs(np.diff(relative)).max()),
            int((np.diff((relative > 0.6).astype(int)) != 0).sum()),
        )


def generated_days(count: int) -> list[Day]:
    return [Day.of(generate_loads(25, 86400.0 - 15, seed).power) for seed in range(count)]


@pytest.fixture(scope="module")
def days() -> list[Day]:
    return [d for d in generated_days(60) if np.isfinite(d.low) and np.isfinite(d.high)]


def test_the_statistics_of_generated_days(days: list[Day]) -> None:
    mean = np.mean([d.autocorrelation for d in days], axis=0)
    # of one day; the mean over 60 is known to about 0.007, 0.013, 0.02
    np.testing.assert_allclose(mean, [0.87, 0.65, 0.31], atol=0.06)
    assert np.mean([d.between_lines for d in days]) == pytest.approx(0.99, abs=0.005)
    level = np.concatenate(
        [generate_loads(25, 86400.0, s, maximum=1.0).power.mean(axis=1) for s in range(10)]
    )
    assert np.median(level[level > 0.6]) == pytest.approx(0.93, abs=0.02)
    assert np.median(level[level < 0.6]) == pytest.approx(0.27, abs=0.02)


def test_the_generated_days_are_like_the_real_one(days: list[Day]) -> None:
    if not FRONTIER.is_file():
        pytest.skip("the Frontier day is not part of this repository; it lies in ../shared/data")
    real = read_loads(FRONTIER)
    assert real.power.shape == (5761, 25)
    assert 275 < real.conditions["wet_bulb"].min() < real.conditions["wet_bulb"].max() < 287
    day = Day.of(real.power)
    assert day.autocorrelation == pytest.approx((0.87, 0.65, 0.31), abs=0.005)
    assert day.between_lines == pytest.approx(0.994, abs=5e-4)
    # the day's noise is less at full load, so its lines go together a little more
    mean = np.mean([d.between_lines for d in days])
    assert mean < day.between_lines < mean + 0.004
    assert np.mean([d.high for d in days]) == pytest.approx(day.high, abs=0.02)
    assert np.mean([d.low for d in days]) == pytest.approx(day.low, abs=0.02)
    assert np.mean([d.switches for d in days]) == pytest.approx(day.switches, abs=5)
    for lag in range(3):
        values = [d.autocorrelation[lag] for d in days]
        spread = np.std(values)
        assert abs(np.mean(values) - day.autocorrelation[lag]) < spread
    # the generator is no steeper than the day
    assert max(d.steepest for d in days) <= day.steepest


def test_the_same_seed_gives_the_same_loads() -> None:
    first, second = (generate_loads(3, 3600.0, 5).power for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, generate_loads(3, 3600.0, 6).power)


def test_loads_stay_within_their_maximum() -> None:
    loads = generate_loads(3, 86400.0, 1, maximum=[40e3, 80e3, 130e3])
    assert (loads.power <= [40e3, 80e3, 130e3]).all()
    assert (loads.power.max(axis=0) > 0.9 * np.array([40e3, 80e3, 130e3])).all()


def test_quiet_lines_are_in_unison() -> None:
    quiet = LoadModel(noise=0.0, jobs=0.0)
    power = generate_loads(4, 7200.0, 2, model=quiet).power
    np.testing.assert_array_equal(power, power[:, :1] * np.ones(4))
    noisy = generate_loads(4, 7200.0, 2).power.mean(axis=1)
    assert np.corrcoef(power[:, 0], noisy)[0, 1] > 0.99  # noise leaves the common signal alone


@pytest.mark.parametrize(
    "arguments", [(0, 60.0, 1), (1, 0.0, 1), (1, 5.0, 1), (1, float("inf"), 1)]
)
def test_loads_that_cannot_be_generated(arguments: tuple[int, float, int]) -> None:
    for make in (generate_loads, lambda *a: training_loads(*a, step=15.0)):
        with pytest.raises(InputError):
            make(*arguments)
    with pytest.raises(InputError, match="maxima"):
        generate_loads(2, 60.0, 1, maximum=[1e3, -1.0])


# ---- AI training --------------------------------------------------------------------------------


def test_training_swings_and_stalls() -> None:
    mode = Training(frequency=0.5, checkpoint=300.0, stall=60.0)
    loads = training_loads(8, 600.0, 3, maximum=100e3, step=0.1, mode=mode)
    power = loads.power
    assert power.min() == pytest.approx(35e3)
    assert power.max() == pytest.approx(95e3)
    assert np.median(np.corrcoef(power.T)[np.triu_indices(8, 1)]) > 0.9  # near unison
    quiet = (np.abs(power - 35e3) < 1).all(axis=1)
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], quiet.astype(int), [0]]))))[::2]
    assert 59 < runs.max() * 0.1 < 62  # s
    spectrum = np.abs(np.fft.rfft(power[:, 0] - power[:, 0].mean()))
    strongest = np.fft.rfftfreq(len(power), 0.1)[spectrum.argmax()]
    assert strongest == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("step", [1.0, 5.0, 7.5])
def test_coarse_steps_keep_the_energy(step: float) -> None:
    fine = training_loads(3, 3600.0, 4, step=0.05).power[: round(3600 / 0.05)]
    coarse = training_loads(3, 3600.0, 4, step=step).power[: round(3600 / step)]
    blocks = fine.reshape(len(coarse), -1, 3).mean(axis=1)
    np.testing.assert_allclose(coarse, blocks, rtol=1e-9)


@pytest.mark.parametrize(
    "wrong", [{"low": 0.9, "high": 0.5}, {"rise": 0.0}, {"top": 0.9}, {"stall": 1e4}]
)
def test_training_that_cannot_be(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        Training(**wrong)


# ---- files --------------------------------------------------------------------------------------

GOOD = (
    "time_s,rack1_kW,rack2_W,wet_bulb_degC\n"
    "0,80,40000,10\n15,81.5,41000,11\n30,82,42000,12\n45,83,43000,12\n"
)


def test_a_file_of_loads(tmp_path: Path) -> None:
    (tmp_path / "loads.csv").write_text(GOOD)
    (tmp_path / "loads.csv.gz").write_bytes(gzip.compress(GOOD.encode()))
    for name in ("loads.csv", "loads.csv.gz"):
        loads = read_loads(tmp_path / name)
        assert loads.names == ("rack1", "rack2")
        np.testing.assert_allclose(loads.at(16.0), [81.5e3, 41e3])
        np.testing.assert_allclose(loads.conditions["wet_bulb"], [283.15, 284.15, 285.15, 285.15])
        np.testing.assert_allclose(loads.sampled([-1.0, 99.0])[:, 0], [80e3, 83e3])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("81.5", "", "row 3, rack1_kW: expected a number"),
        ("81.5", "nan", "row 3, rack1_kW: expected a finite number"),
        ("81.5", "eighty", "expected a number"),
        ("81.5", "-1", "non-negative"),
        ("81.5", "81500000", "check the unit"),
        ("15,", "45,", "increasing times"),
        ("15,", "0,", "increasing times"),
        ("45,83", "300,83", "gap of 270 s"),
        ("rack1_kW", "rack1", "ends in a unit"),
        ("rack1_kW", "rack1_bar", "ends in a unit"),
        ("time_s", "t", "time_s"),
        (",42000", "", "row 4: expected 4 values"),
        ("rack1_kW,rack2_W", "a_degC,b_K", "expected a column with a load"),
        (GOOD, "", "row of names"),
        (GOOD, "\0\0", "expected"),
    ],
)
def test_files_that_cannot_be_used(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "loads.csv"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(InputError, match=message) as caught:
        read_loads(path)
    assert "loads.csv" in str(caught.value)


def test_a_gap_can_be_allowed(tmp_path: Path) -> None:
    path = tmp_path / "loads.csv"
    path.write_text(GOOD.replace("45,83", "300,83"))
    assert read_loads(path, max_gap=300.0).at(200.0)[0] == 82e3


@pytest.mark.parametrize("content", [None, b"\x1f\x8bbroken", b"\xff\xfe\x00"])
def test_files_that_cannot_be_read(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "loads.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError):
        read_loads(path)
    with pytest.raises(InputError):
        read_loads(tmp_path)


@pytest.mark.parametrize(
    ("time", "power", "message"),
    [
        ([0.0], [[1.0], [2.0]], "expected"),
        ([], np.empty((0, 1)), "at least one"),
        ([0.0, np.nan], [[1.0], [2.0]], "finite times"),
        ([0.0, 1.0], [[1.0], [np.inf]], "finite loads"),
    ],
)
def test_loads_that_do_not_fit(time: object, power: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Loads(time, power)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="names"):
        Loads([0.0], [[1.0]], ("a", "b"))


# ---- sensors ------------------------------------------------------------------------------------


def test_a_sensor_adds_noise_and_rounds() -> None:
    random = np.random.default_rng(1)
    read = Sensor().read(np.full(100_000, 310.13), random)
    np.testing.assert_allclose(read / 0.1, np.round(read / 0.1), atol=1e-6)
    assert read.mean() == pytest.approx(310.13, abs=2e-3)
    assert read.std() == pytest.approx(np.hypot(0.05, 0.1 / np.sqrt(12)), rel=0.02)
    np.testing.assert_array_equal(Sensor(0.0, 0.0).read([310.13], random), [310.13])
