"""The KPI page: what it says, from folders as `[compare]` leaves them."""

from __future__ import annotations

import json
import re
import shutil

import pytest
from kpi_runs import comparison

from posmas_fmi.errors import InputError
from posmas_fmi.report import write_report
from posmas_fmi.report.kpi_data import read_kpis
from posmas_fmi.report.kpi_wording import advice, headline


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return comparison(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def page(folder):
    return write_report(folder).read_text(encoding="utf-8")


def edit(folder, **changes):
    path = folder / "summary.json"
    content = json.loads(path.read_text())
    content.update(changes)
    path.write_text(json.dumps(content))
    return content


def plain(html):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", html))


def test_the_decision_is_in_the_first_sentence(folder, page):
    text = headline(read_kpis(folder))
    assert text.startswith("integral is better than practice (pi)")
    assert "0.521 K against 1.22 K" in text
    assert text in plain(page)


def test_practice_stays_where_nothing_is_clearly_better(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "run")
    content = edit(tmp_path / "run")
    figures = content["comparison"]
    figures["integral"]["worst_K"] = 0.97 * figures["pi"]["worst_K"]
    figures["integral"]["limits"]["band"] = False
    edit(tmp_path / "run", comparison=figures)
    run = read_kpis(tmp_path / "run")
    assert run.best.name == "pi"
    assert headline(run).startswith("Stay with practice: pi breaks the limit “band”")


def test_a_limit_outweighs_a_smaller_deviation(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "run")
    figures = edit(tmp_path / "run")["comparison"]
    figures["integral"]["limits"]["positivity"] = False
    figures["pi"]["limits"]["band"] = True
    edit(tmp_path / "run", comparison=figures)
    assert read_kpis(tmp_path / "run").best.name == "pi"


def test_the_best_of_a_row_is_marked_in_words(page):
    rows = re.findall(r"<tr><th scope=\"row\">(.*?)</tr>", page.split('id="figures"')[1], re.S)
    worst = plain(next(r for r in rows if r.startswith("Worst deviation")))
    assert re.search(r"K\] 1.22 1.52 ✗ worse, 25 % more ★ best 0.521 ✓ better, 57 % less", worst)
    messages = plain(next(r for r in rows if r.startswith("Messages")))
    assert "best" not in messages
    assert "better" not in messages


def test_equal_figures_have_no_winner(tmp_path):
    folder = comparison(tmp_path, controllers=["pi", "integral"], step=60.0)
    figures = edit(folder)["comparison"]
    figures["integral"]["rms_K"] = 1.01 * figures["pi"]["rms_K"]
    edit(folder, comparison=figures)
    run = read_kpis(folder)
    assert run.better(run.kpis[0]) == frozenset()
    assert "= as practice" in write_report(folder).read_text(encoding="utf-8")


def test_every_limit_has_a_verdict_and_an_unknown_one_says_so(page):
    table = plain(page.split('id="limits-table"')[1].split("</table>")[0])
    assert table.count("✓ kept") == 4
    assert table.count("✗ broken") == 2
    assert table.count("? not known") == 3


def test_the_same_files_give_the_same_bytes(folder, page):
    assert write_report(folder).read_text(encoding="utf-8") == page


def test_a_single_cooling_run_has_both_pages(tmp_path):
    from report_runs import example_1

    folder = comparison(tmp_path / "a", controllers=["integral"], practice=None, n=4, step=60.0)
    single = example_1(tmp_path / "b")
    summary = json.loads((single / "summary.json").read_text())
    compared = json.loads((folder / "summary.json").read_text())
    (single / "summary.json").write_text(json.dumps({**compared, **summary}))
    assert write_report(single).name == "report.html"
    page = (single / "kpi.html").read_text(encoding="utf-8")
    assert "integral breaks" in page or "integral keeps" in page
    assert 'id="network"' not in page  # no supply temperature was recorded
    assert "kpi.html" in (single / "report.html").read_text(encoding="utf-8")


def test_faults_and_incidents_are_shown(tmp_path):
    folder = comparison(
        tmp_path, n=3, step=60.0,
        faults=[{"kind": "leader_lost", "agent": None, "from": 600.0, "until": 1200.0,
                 "detail": "no set-point", "covered": "D"}],
        incidents=[{"agent": "2", "time": 61.0, "call": "doStep", "verdict": "died",
                    "fmu": "line.fmu", "inputs": {"u": 0.5, "q": None}, "action": "restarted",
                    "detail": "3 steps done again"}],
    )  # fmt: skip
    text = plain(write_report(folder).read_text(encoding="utf-8"))
    assert "leader_lost – from 10 min to 20 min no set-point D" in text
    assert "2 1 min 1 s doStep of line.fmu died (inputs u = 0.5, q = not finite)" in text
    assert "restarted: 3 steps done again" in text


def test_a_controller_that_left_no_results_still_has_its_figures(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "integral")
    text = plain(write_report(tmp_path / "run").read_text(encoding="utf-8"))
    assert "integral is better than practice" in text


def test_a_controller_cannot_name_a_folder_elsewhere(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "run")
    figures = edit(tmp_path / "run")["comparison"]
    edit(tmp_path / "run", comparison={"../other": figures["pi"]}, practice=None)
    shutil.copytree(folder / "pi", tmp_path / "other")
    assert read_kpis(tmp_path / "run").controllers[0].signals is None


@pytest.mark.parametrize(
    "changes",
    [{"comparison": {"pi": 3}}, {"kpi": {"rms_K": 1}}, {"limits": [{"name": "x", "limit": "no"}]}],
    ids=["comparison", "kpi", "limits"],
)
def test_a_broken_summary_is_an_error_that_names_the_key(folder, tmp_path, changes):
    shutil.copytree(folder, tmp_path / "run")
    edit(tmp_path / "run", **changes)
    with pytest.raises(InputError, match=next(iter(changes))):
        write_report(tmp_path / "run")


def test_values_that_are_not_finite_are_not_known_and_not_coloured(tmp_path):
    import xarray

    folder = comparison(tmp_path, n=3, step=60.0)
    path = folder / "pi" / "results.nc"
    with xarray.open_dataset(path) as results:
        changed = results.load()
    changed["supply_temperature"][40:, 1] = float("nan")
    changed.to_netcdf(path, engine="h5netcdf")
    page = write_report(folder).read_text(encoding="utf-8")
    data = json.loads(page.split('id="network-data">')[1].split("</script>")[0])
    import base64

    codes = base64.b64decode(data["controllers"]["pi"])
    assert codes[-4:-2] == b"\xff\xff"  # line 2 of 3 at the end, "not known"


def test_of_many_lines_the_page_says_whose_cycles_it_counts(page, tmp_path):
    assert "A dot for each of" not in page
    text = write_report(comparison(tmp_path, n=70, step=120.0)).read_text(encoding="utf-8")
    assert "A dot for each of 64 of the 70 lines, evenly chosen, a bar at their mean." in text


def test_the_advice_tells_what_the_better_one_is_worse_at(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "run")
    figures = json.loads((folder / "summary.json").read_text())["comparison"]
    figures["integral"]["rms_K"] = 2 * figures["pi"]["rms_K"]
    edit(tmp_path / "run", comparison=figures)
    found = read_kpis(tmp_path / "run")
    assert found.best.name == "integral"
    assert "rms deviation is larger" in advice(found).lower()
