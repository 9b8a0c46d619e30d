"""The page in a real browser: nothing is fetched, nothing complains, everything is visible."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import open_page, start
from report_runs import RUNS, example_1

from posmas_fmi.report import write_report

SECTIONS = (
    "verdict", "network", "states", "inputs", "certificate", "gains", "baseline", "provenance",
    "reading",
)  # fmt: skip


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    yield from start(tmp_path_factory.mktemp("profile"))


@pytest.fixture(scope="module", params=list(RUNS))
def page(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report(RUNS[request.param](tmp_path_factory.mktemp("run")))


def test_nothing_is_fetched_and_nothing_complains(browser: Any, page: Path) -> None:
    requests = open_page(browser, page, 1280)
    assert [url for url in requests if not url.startswith("data:")] == [page.as_uri()]
    assert browser.get_log("browser") == []


def test_every_section_has_a_heading_and_a_size(browser: Any, page: Path) -> None:
    open_page(browser, page, 1280)
    for section in SECTIONS:
        element = browser.find_element("id", section)
        assert element.size["height"] > 40, section
        assert element.is_displayed()
    linked = browser.find_elements("css selector", "nav a")
    sections = browser.find_elements("css selector", "main > section")
    assert len(linked) == len(sections) >= len(SECTIONS) - 1
    for link, section in zip(linked, sections, strict=True):
        assert link.get_attribute("href").endswith(f"#{section.get_attribute('id')}")


def test_every_drawing_is_visible_and_described(browser: Any, page: Path) -> None:
    open_page(browser, page, 1280)
    plots = browser.find_elements("css selector", "svg.plot")
    assert len(plots) >= 8
    for plot in plots:
        assert plot.get_attribute("role") == "img"
        assert len(plot.get_attribute("aria-label")) > 40
        # what is drawn lies in the box that the page gives it
        box, ink = browser.execute_script(
            "const s = arguments[0], v = s.viewBox.baseVal, b = s.getBBox();"
            "return [[v.width, v.height], [b.width, b.height]]",
            plot,
        )
        assert plot.size["width"] > 250
        assert plot.size["height"] > 100
        assert 0.5 * box[0] < ink[0] <= 1.1 * box[0]
        assert 0.4 * box[1] < ink[1] <= 1.1 * box[1]


@pytest.mark.parametrize("width", [1280, 400])
def test_no_sideways_scrolling(browser: Any, page: Path, width: int) -> None:
    open_page(browser, page, width)
    inner, client = browser.execute_script(
        "return [document.documentElement.scrollWidth, document.documentElement.clientWidth]"
    )
    assert inner <= client
    assert client > width - 30


def test_keyboard_reaches_the_contents_first(browser: Any, page: Path) -> None:
    from selenium.webdriver.common.keys import Keys

    open_page(browser, page, 1280)
    browser.find_element("css selector", "body").send_keys(Keys.TAB)
    focused = browser.switch_to.active_element
    assert focused.get_attribute("class") == "skip"
    assert focused.location["x"] >= 0  # shown once it has the focus
    focused.send_keys(Keys.TAB)
    assert browser.switch_to.active_element.get_attribute("href").endswith("#network")


def test_hostile_names_do_nothing(browser: Any, tmp_path: Path) -> None:
    names = [
        "<script>document.title='taken'</script>",
        "<img src=x onerror=\"document.title='taken'\">",
        "<svg onload=\"document.title='taken'\">",
        "a" * 300,
    ]
    page = write_report(example_1(tmp_path, names=names))
    requests = open_page(browser, page, 400)
    assert browser.title == "paper-example-1 – run report"
    assert [url for url in requests if not url.startswith("data:")] == [page.as_uri()]
    assert browser.get_log("browser") == []
    assert names[0] in browser.find_element("css selector", "#network tbody").text
    width, client = browser.execute_script(
        "return [document.documentElement.scrollWidth, document.documentElement.clientWidth]"
    )
    assert width <= client


def test_it_prints(browser: Any, page: Path) -> None:
    open_page(browser, page, 1280)
    printed = browser.execute_cdp_cmd("Page.printToPDF", {"printBackground": True})
    assert len(printed["data"]) > 20_000
