"""The page as text: what it says, that it is self-contained, that bad input is one clear error."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from report_runs import (
    ARCS,
    RUNS,
    K,
    cut_off,
    design_facts,
    example_1,
    example_1_printed,
    laplacians,
    many_agents,
    simulate,
    write_run,
)

from posmas_fmi.errors import InputError
from posmas_fmi.report import write_report
from posmas_fmi.report.reading import read_run


def copy_files(source: Path, target: Path) -> None:
    for path in source.iterdir():
        (target / path.name).write_bytes(path.read_bytes())


class _Page(HTMLParser):
    """Elements, attributes and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.texts: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(key, value or "") for key, value in attrs]

    def handle_data(self, data: str) -> None:
        self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())


def page_of(folder: Path) -> str:
    return write_report(folder).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def converged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = example_1(tmp_path_factory.mktemp("run"))
    write_report(folder)
    return folder


@pytest.fixture(scope="module")
def converged_text(converged: Path) -> str:
    return _Page((converged / "report.html").read_text(encoding="utf-8")).text


@pytest.fixture(scope="module", params=list(RUNS))
def every_page(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    return page_of(RUNS[request.param](tmp_path_factory.mktemp("run")))


def test_page_is_self_contained(every_page: str) -> None:
    page, parsed = every_page, _Page(every_page)

    assert "script" not in parsed.tags
    loading = {"img", "iframe", "object", "embed", "audio", "video", "source", "base", "form"}
    assert loading.isdisjoint(parsed.tags)
    links = [value for key, value in parsed.attributes if key in ("href", "src", "xlink:href")]
    assert all(value.startswith(("#", "data:")) for value in links)
    assert not re.search(r"https?://", page)
    assert "@import" not in page
    assert not [key for key, _ in parsed.attributes if key.startswith("on")]


def test_ids_are_unique_and_references_resolve(every_page: str) -> None:
    parsed = _Page(every_page)
    ids = [value for key, value in parsed.attributes if key == "id"]
    assert len(ids) == len(set(ids))
    wanted = {value[1:] for key, value in parsed.attributes if key == "href" and value[0] == "#"}
    for _, value in parsed.attributes:
        wanted |= set(re.findall(r"url\(#([^)]+)\)", value))
    wanted |= {v for key, v in parsed.attributes if key == "aria-labelledby"}
    assert wanted <= set(ids)


def test_settings_of_the_user_neither_matter_nor_change(converged: Path) -> None:
    import matplotlib

    plain = (converged / "report.html").read_bytes()
    with matplotlib.rc_context({"lines.linewidth": 9.0, "font.size": 30.0, "svg.fonttype": "path"}):
        before = dict(matplotlib.rcParams)
        assert write_report(converged).read_bytes() == plain
        assert dict(matplotlib.rcParams) == before


def test_converged_run_names_the_contradicted_assumption(converged_text: str) -> None:
    text = converged_text
    assert "All 4 agents reached the leader" in text
    assert "no state became negative" in text
    assert "only on condition of “lipschitz” (which the model contradicts)" in text
    assert "✗ contradicted" in text
    assert "at t = 10, x1 = 4 the slope of g1 is 13.2" in text
    assert "sec(u)/u ranges over [0.9, 1.2], inside the sector [0.9, 1.2]" in text


def test_every_condition_is_listed_with_margin_and_proof(converged_text: str) -> None:
    text = converged_text
    for condition in design_facts()["conditions"]:
        assert condition["name"] in text
        assert condition["proof"] in text
    assert text.count("✓ holds") == 3


def test_gains_are_on_the_page(converged_text: str) -> None:
    text = converged_text
    for value in ("−0.5725", "−0.5786", "−0.1724", "3.7982", "3.0183"):
        assert value in text


def test_diverged_run_says_who_was_lost_and_when(tmp_path: Path) -> None:
    folder = example_1_printed(tmp_path)
    text = _Page(page_of(folder)).text
    run = read_run(folder)
    assert run.first_lost is not None
    agent, time = run.first_lost
    assert run.names[agent] == "2"  # the pinned one: its feedback is positive
    assert f"diverged (agent 2 is lost from t = {time:.3g} s)" in text
    assert "positivity is lost" in text
    assert "“C: closed loop contracts” failed" in text


@pytest.mark.parametrize(
    ("verdict", "complete", "expected"),
    [
        ("not converged", 1, "Not converged: the largest tracking error is"),
        ("not settled", 1, "Not settled: the largest tracking error is"),
        ("positivity lost", 1, "Positivity is lost (lowest state −0.4), the tracking error is"),
        ("failed", 0, "An FMU failed at t = 0.5 s"),
        ("cancelled", 0, "The run was cancelled at t = 0.5 s: the largest tracking error was"),
    ],
)
def test_every_verdict_of_the_master_is_put_into_words(
    verdict: str, complete: int, expected: str, tmp_path: Path
) -> None:
    lp, d = laplacians(4, ARCS, [2])
    signals = simulate(lp, d, until=0.5)
    write_run(tmp_path, signals, ARCS, [2], verdict=verdict, complete=complete)
    path = tmp_path / "summary.json"
    summary = json.loads(path.read_text(encoding="utf-8"))
    summary["reason"] = "agent 3: doStep returned Error"
    if verdict == "positivity lost":
        summary["min_state"] = -0.4
    summary["agents"][2]["min_state"] = 0.1234
    path.write_text(json.dumps(summary), encoding="utf-8")
    text = _Page(page_of(tmp_path)).text
    assert expected in text
    assert "Agent 3: doStep returned Error." in text
    assert ("another coupling, before judging it" in text) == (verdict == "not settled")
    assert "0.123" in text
    assert "no state became negative" not in text or verdict != "positivity lost"


@pytest.mark.parametrize("tail", ["huge", "infinite", "missing"])
def test_absurd_values_still_give_a_report(tail: str, tmp_path: Path) -> None:
    lp, d = laplacians(4, ARCS, [2])
    signals = simulate(lp, d, until=2.0)
    value = {"huge": 1e300, "infinite": np.inf, "missing": np.nan}[tail]
    for name in ("x", "xhat", "u", "sec_u", "y"):
        signals[name][200:, 2] = value
    folder = write_run(tmp_path, signals, ARCS, [2], verdict="diverged")
    text = _Page(page_of(folder)).text
    assert "agent 3 is lost from t = 1 s" in text


def test_loss_of_the_leader_and_of_everything(tmp_path: Path) -> None:
    lp, d = laplacians(4, ARCS, [2])
    signals = simulate(lp, d, until=1.0)
    for name, values in signals.items():
        if name != "time":
            values[100:] = np.inf
    text = _Page(page_of(write_run(tmp_path, signals, ARCS, [2], verdict="diverged"))).text
    assert "is lost from t = 0.5 s" in text


def test_cut_off_run_says_so_without_a_summary(tmp_path: Path) -> None:
    folder = cut_off(tmp_path, steps=400)
    run = read_run(folder)
    assert run.time.size == 400
    assert run.summary.steps == 399
    text = _Page(page_of(folder)).text
    assert "The run was cut off at t = 2 s" in text
    error = np.abs(run.x[-1] - run.s[-1]).max()
    assert f"the largest tracking error was {error:.3g} by then" in text


def test_run_without_a_single_sample(tmp_path: Path) -> None:
    text = _Page(page_of(cut_off(tmp_path, steps=0))).text
    assert "Nothing was recorded before the run was cut off" in text


def test_run_with_one_sample(tmp_path: Path) -> None:
    page = page_of(cut_off(tmp_path, steps=1))
    assert page.count('class="plot"') > 8


def test_plant_without_states(tmp_path: Path) -> None:
    text = _Page(page_of(RUNS["example_1_without_x"](tmp_path))).text
    assert "This plant does not show its states" in text
    assert "as far as the observers tell" in text
    assert "did not record sec(u)" in text


def test_states_of_some_agents_only(tmp_path: Path) -> None:
    lp, d = laplacians(4, ARCS, [2])
    signals = simulate(lp, d, until=1.0)
    signals["x"][:, 1] = np.nan
    run = read_run(write_run(tmp_path, signals, ARCS, [2]))
    np.testing.assert_array_equal(run.shown[:, 1], run.xhat[:, 1])
    np.testing.assert_array_equal(run.shown[:, 0], run.x[:, 0])
    assert run.first_lost is None
    page_of(tmp_path)


def test_baseline_is_shown_with_its_rate_and_trajectory(
    converged_text: str, tmp_path: Path
) -> None:
    text = converged_text
    assert "the best proved rate is −0.13 1/s, against 0.254 1/s with the designed gains" in text
    assert "did not record a trajectory with K = 0" not in text
    lp, d = laplacians(4, ARCS, [2])
    other = write_run(tmp_path, simulate(lp, d, gain=K, until=0.5), ARCS, [2])
    assert "did not record a trajectory with K = 0" in _Page(page_of(other)).text


def test_arcs_point_from_heard_to_hearing(converged: Path) -> None:
    run = read_run(converged)
    expected = np.zeros((4, 4))
    for source, target in ARCS:
        expected[target - 1, source - 1] = 1.0
    np.testing.assert_array_equal(run.network.adjacency.toarray(), expected)
    assert run.network.p.max() == pytest.approx(5.0)  # theory.md, section 6


def test_many_agents_are_summarised_but_all_listed(tmp_path: Path) -> None:
    folder = many_agents(tmp_path)
    page = page_of(folder)
    assert page == page_of(folder)  # the same files, the same bytes
    text = _Page(page).text
    assert "200 agents are too many for a drawing" in text
    assert "The other 188 agents" in text
    assert len(page) < 1_500_000
    run = read_run(folder)
    assert f"agent {run.names[run.worst]} (largest final error)" in text


HOSTILE = (
    "<script>alert(1)</script>",
    '"onload=alert(1) id="figure_1" x="url(#a)',
    "$\\frac{1",
    "冷却\x00\ud800‮1",
)


def test_hostile_names_are_text(tmp_path: Path) -> None:
    names = [name.replace("\ud800", "").replace("\x00", "") for name in HOSTILE]
    example_1(tmp_path, names=names, scenario="<b onclick=x>&amp;</b>")
    path = tmp_path / "design.json"
    facts = design_facts()
    facts["conditions"][0]["proof"] = "</td><script>alert(2)</script>"
    facts["assumptions"][0]["name"] = "<img src=x onerror=alert(3)>"
    facts["notes"] = ["</style><script>alert(4)</script>\ud800"]
    path.write_text(json.dumps(facts), encoding="utf-8")
    page = page_of(tmp_path)
    parsed = _Page(page)
    assert "script" not in parsed.tags
    assert "img" not in parsed.tags
    assert "onload" not in dict(parsed.attributes)
    assert "<script>alert(1)</script>" in parsed.text
    assert "<b onclick=x>&amp;</b>" in parsed.text
    assert "‮" not in page


def test_text_in_a_drawing_is_text(tmp_path: Path) -> None:
    example_1(tmp_path, names=["<i>", "$1", "&lt", "a"])
    parsed = _Page(page_of(tmp_path))
    for name in ("<i>", "$1", "&lt"):
        assert name in parsed.texts


def test_values_outside_the_sector_are_reported(tmp_path: Path) -> None:
    lp, d = laplacians(4, ARCS, [2])
    signals = simulate(lp, d, until=1.0)
    signals["sec_u"] = np.clip(signals["u"], -0.3, 0.3)
    text = _Page(page_of(write_run(tmp_path, signals, ARCS, [2]))).text
    assert "of the samples lie outside the sector [0.9, 1.2], against the proof" in text


def test_sector_comes_from_the_scenario_if_the_design_has_none(tmp_path: Path) -> None:
    folder = example_1(tmp_path)
    facts = design_facts()
    del facts["sector"]
    (folder / "design.json").write_text(json.dumps(facts), encoding="utf-8")
    assert read_run(folder).design.sector == (0.9, 1.2)


def test_long_runs_are_read_with_a_stride(converged: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = read_run(converged)
    monkeypatch.setattr("posmas_fmi.report.results_file.LARGEST_VARIABLE", 5000)
    thin = read_run(converged)
    assert thin.stride == 4
    np.testing.assert_array_equal(thin.time, whole.time[::4])
    np.testing.assert_array_equal(thin.x, whole.x[::4])
    monkeypatch.setattr("posmas_fmi.report.results_file.LARGEST_VARIABLE", 6000)
    thin = read_run(converged)
    assert thin.stride == 3
    assert thin.time[-1] == whole.time[-1]
    np.testing.assert_array_equal(thin.final_error, whole.final_error)


def test_summary_comparison_becomes_a_table(tmp_path: Path) -> None:
    folder = example_1(tmp_path)
    path = folder / "summary.json"
    summary = json.loads(path.read_text(encoding="utf-8"))
    summary["comparison"] = {"consensus": {"rms K": 0.15, "strokes": 2}, "PI": {"rms K": 0.09}}
    summary["messages"] = ["agent 3: start value of x2 was read back as 1.0"]
    path.write_text(json.dumps(summary), encoding="utf-8")
    text = _Page(page_of(folder)).text
    assert "Controller rms K strokes consensus 0.15 2 PI 0.09 –" in text
    assert "start value of x2 was read back as 1.0" in text


@pytest.mark.parametrize(
    "name", ["results.nc", "design.json", "summary.json", "manifest.json"]
)  # fmt: skip
@pytest.mark.parametrize("damage", ["missing", "empty", "binary", "folder", "cut", "holes"])
def test_bad_file_is_one_error_with_name_and_remedy(
    name: str, damage: str, converged: Path, tmp_path: Path
) -> None:
    copy_files(converged, tmp_path)
    path = tmp_path / name
    content = path.read_bytes()
    path.unlink()
    if damage == "folder":
        path.mkdir()
    elif damage != "missing":
        damaged = {
            "empty": b"",
            "binary": b"\x00\xff" * 50,
            "cut": content[:-40],
            "holes": content[:96] + bytes(len(content) - 96),
        }
        path.write_bytes(damaged[damage])
    with pytest.raises(InputError, match="posmas-fmi run") as caught:
        write_report(tmp_path)
    assert caught.value.where == str(path)


@pytest.mark.parametrize(
    ("file", "key", "value"),
    [
        ("design.json", "K", "text"),
        ("design.json", "K", [[1.0], [1.0, 2.0]]),
        ("design.json", "certified", "maybe"),
        ("design.json", "rate", "fast"),
        ("design.json", "positive", None),
        ("design.json", "conditions", {"name": 1}),
        ("design.json", "conditions", [{"name": "P", "holds": "yes"}]),
        ("design.json", "assumptions", [{"name": "a", "status": "hoped"}]),
        ("design.json", "baseline", [1]),
        ("summary.json", "verdict", 3),
        ("summary.json", "agents", None),
        ("summary.json", "min_state", "low"),
    ],
)
def test_wrong_value_names_its_key(
    file: str, key: str, value: object, converged: Path, tmp_path: Path
) -> None:
    copy_files(converged, tmp_path)
    path = tmp_path / file
    content = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**content, key: value}), encoding="utf-8")
    with pytest.raises(InputError, match=rf"\$\.{key}") as caught:
        write_report(tmp_path)
    assert caught.value.where == str(path)


def test_results_of_something_else(converged: Path, tmp_path: Path) -> None:
    copy_files(converged, tmp_path)
    path = tmp_path / "results.nc"
    xr.Dataset({"temperature": ("day", [1.0, 2.0])}).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(InputError, match=r"expected a variable 'time' \(found temperature\)"):
        write_report(tmp_path)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            "u",
            lambda v: v.isel(input=0, drop=True),
            r"expected numbers over \(time, agent, input\)",
        ),
        ("arc_to", lambda v: v + 7, "expected agents from 0 to 3"),
        ("arc_to", lambda v: 0 * v, "the stored network is not usable"),
        ("pinning", lambda v: -v, "the stored network is not usable"),
    ],
)
def test_wrong_variable_is_named(
    name: str, change: object, message: str, converged: Path, tmp_path: Path
) -> None:
    copy_files(converged, tmp_path)
    with xr.open_dataset(converged / "results.nc", engine="h5netcdf", decode_times=False) as good:
        bad = good.load().assign({name: change(good[name])})  # type: ignore[operator]
    bad.to_netcdf(tmp_path / "results.nc", engine="h5netcdf")
    with pytest.raises(InputError, match=message):
        write_report(tmp_path)


def test_no_folder_and_a_file_in_its_place(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is none"):
        write_report(tmp_path / "nothing")
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="a file"):
        write_report(tmp_path / "file")
