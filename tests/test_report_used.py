"""The report of a run says what went wrong, what was recorded besides, and what is not covered."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import open_page, start
from report_runs import design_facts, with_faults

import posmas_fmi
from posmas_fmi.errors import InputError
from posmas_fmi.report import write_report
from posmas_fmi.report.figures import faulty
from posmas_fmi.report.reading import read_run

PROVED = design_facts(certified="yes", assumptions=[])


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    yield from start(tmp_path_factory.mktemp("profile"))


def test_what_was_recorded_is_read_with_its_dimensions(tmp_path: Path) -> None:
    run = read_run(with_faults(tmp_path))
    assert {name: values.shape for name, values in run.recorded.items()} == {
        "heat_load": (2001, 4),
        "facility.T_supply": (2001,),
    }
    assert run.recorded["facility.T_supply"].max() == pytest.approx(305.35, abs=1e-3)


def test_faults_are_shaded_as_far_as_the_run_went(tmp_path: Path) -> None:
    run = read_run(with_faults(tmp_path))
    assert faulty(run) == [(2.0, 4.0), (7.0, 10.0)]


def test_the_page_shows_it_all(browser: Any, tmp_path: Path) -> None:
    open_page(browser, write_report(with_faults(tmp_path, design=PROVED)), 1280)

    def rows(table: str) -> list[list[str]]:
        found = browser.find_elements("css selector", f"{table} tbody tr")
        return [[cell.text for cell in row.find_elements("xpath", "*")] for row in found]

    assert rows("#faults div:nth-of-type(1)") == [
        ["sensor bias", "3", "2 s to 4 s", "an added value", "✗ not covered, but bounded"],
        [
            "leader lost",
            "all",
            "7 s to the end",
            "the last state heard is held",
            "✓ covered by certificate D as a delay",
        ],
    ]
    assert rows("#faults div:nth-of-type(2)") == [
        ["2", "5.125", "killed by signal 9", "frozen: its last outputs are held"]
    ]
    assert rows("#used") == [
        ["delay of messages", "✓ covered", "certificate D: held"],
        ["rounded messages", "✗ not covered", "a bounded disturbance"],
    ]
    plots = browser.find_elements("css selector", "#recorded svg.plot")
    assert [plot.get_attribute("aria-label").split(" of ")[0] for plot in plots] == [
        "Recorded variable heat_load",
        "Recorded variable facility.T_supply from t = 0 to 10 s. At the start 305, at the end 305. "
        "Extremes 305 and 305.",
    ]
    verdict = browser.find_element("id", "verdict")
    assert "caution" in verdict.get_attribute("class")
    assert "not for all that this run used" in verdict.text
    assert "rounded messages, sensor bias and an FMU that failed" in verdict.text
    assert "a fault holds" in browser.find_element("css selector", "ul.legend").text


@pytest.mark.parametrize("field", ["coverage", "faults", "incidents"])
def test_one_thing_that_is_not_covered_is_enough_for_caution(field: str, tmp_path: Path) -> None:
    nothing: dict[str, Any] = {"coverage": [], "faults": [], "incidents": []}
    calm = write_report(with_faults(tmp_path / "calm", design=PROVED, **nothing))
    text = calm.read_text(encoding="utf-8")
    assert 'class="verdict good"' in text
    assert "are those of the loop that the certificate is about" in text
    assert 'id="faults"' not in text
    del nothing[field]
    one = write_report(with_faults(tmp_path / "one", design=PROVED, **nothing))
    assert 'class="verdict caution"' in one.read_text(encoding="utf-8")


def test_nothing_recorded_besides_leaves_no_section(tmp_path: Path) -> None:
    text = write_report(with_faults(tmp_path, recorded={})).read_text(encoding="utf-8")
    assert 'id="recorded"' not in text


def test_beyond_twelve_recorded_variables_are_named(tmp_path: Path) -> None:
    many = {f"v{k}": np.linspace(0.0, k, 2001) for k in range(14)}
    text = write_report(with_faults(tmp_path, recorded=many)).read_text(encoding="utf-8")
    assert "Not drawn: v12, v13." in text


@pytest.mark.parametrize(
    ("field", "value", "word"),
    [
        ("faults", "none", "a list of objects"),
        ("faults", [{"kind": 3}], "$.faults[0].kind"),
        ("coverage", [{"what": "delay", "covered": "yes"}], "$.coverage[0].covered"),
        ("incidents", [{"time": "soon"}], "$.incidents[0].time"),
    ],
)
def test_nonsense_is_one_error_with_its_place(
    field: str, value: Any, word: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as caught:
        write_report(with_faults(tmp_path, **{field: value}))
    assert word in str(caught.value)


def test_a_real_run_with_a_fault(tmp_path: Path) -> None:
    text = (posmas_fmi.load("paper_example_1_tanh")).text
    text = text.replace('"y[2]"}', '"y[2]"}\nrecord = ["u[1]"]').replace("10.0 ", "1.0 ", 1)
    text += '\n[channel]\ndelay = 0.02\n[[fault]]\nkind = "sensor stuck"\nat = 0.5\nagents = [3]\n'
    path = tmp_path / "case.toml"
    path.write_text(text, encoding="utf-8")
    posmas_fmi.run(posmas_fmi.load(path), tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "sensor stuck" in page
    assert "delay of messages" in page
    assert "Recorded variable u[1]" in page
