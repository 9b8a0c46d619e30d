"""The KPI page in a real browser: the slider, the keyboard, narrow and wide, nothing fetched."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import open_page, start
from kpi_runs import comparison

from posmas_fmi.report import write_report

RUNS = {
    "three": {},
    "single": {"controllers": ["integral"], "practice": None, "n": 3},
    "thousand": {"n": 1000, "step": 60.0},
}


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    yield from start(tmp_path_factory.mktemp("profile"))


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {
        name: write_report(comparison(tmp_path_factory.mktemp(name), **options))
        for name, options in RUNS.items()
    }


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize("width", [400, 1280])
def test_nothing_is_fetched_nothing_complains_nothing_overflows(browser, pages, name, width):
    requests = open_page(browser, pages[name], width)
    assert [url for url in requests if not url.startswith("data:")] == [pages[name].as_uri()]
    assert browser.get_log("browser") == []
    inner, client = browser.execute_script(
        "return [document.documentElement.scrollWidth, document.documentElement.clientWidth]"
    )
    assert inner <= client


def fills(browser: Any) -> list[str]:
    return browser.execute_script(
        "return Array.from(document.querySelectorAll('.view:first-child .line'))"
        ".map(g => g.querySelector('circle, rect').getAttribute('fill'))"
    )


def test_the_slider_recolours_the_network_and_is_worked_by_keys(browser, pages):
    from selenium.webdriver.common.keys import Keys

    open_page(browser, pages["three"], 1280)
    slider = browser.find_element("id", "moment")
    clock = browser.find_element("id", "clock")
    assert clock.text == "t = 30 min"  # it starts at the worst moment
    at_worst = fills(browser)
    assert len(at_worst) == 8
    assert all(colour.startswith("#") for colour in at_worst)
    slider.send_keys(Keys.HOME)
    assert clock.text == "t = 0 s"
    assert fills(browser) != at_worst
    slider.send_keys(Keys.ARROW_RIGHT)
    assert clock.text != "t = 0 s"
    assert slider.get_attribute("aria-valuetext") == clock.text.removeprefix("t = ")
    slider.send_keys(Keys.END)
    assert clock.text == "t = 2 h 0 min"
    assert "2 h 0 min" in browser.find_element("css selector", ".view svg.net").get_attribute(
        "aria-label"
    )


def test_controllers_can_be_chosen_and_practice_stays_beside(browser, pages):
    from selenium.webdriver.common.keys import Keys

    open_page(browser, pages["three"], 1280)
    first, second = browser.find_elements("css selector", ".view")
    assert first.find_element("css selector", ".who").text == "integral"
    assert second.find_element("css selector", ".who").text == "pi"
    before, reading = fills(browser), first.find_element("css selector", ".reading").text
    assert "All inside ±1 K" in reading
    browser.find_element("css selector", "input[value=proportional]").send_keys(Keys.SPACE)
    assert first.find_element("css selector", ".who").text == "proportional"
    assert fills(browser) != before
    assert "outside ±1 K" in first.find_element("css selector", ".reading").text
    assert second.find_element("css selector", ".who").text == "pi"


def test_lines_outside_the_band_carry_a_mark_and_not_only_a_colour(browser, pages):
    open_page(browser, pages["three"], 1280)
    marked = browser.execute_script(
        "return Array.from(document.querySelectorAll('.view:last-child .line')).map(g => "
        "[g.classList.contains('warm'), getComputedStyle(g.querySelector('path')).fill, "
        "g.querySelector('title').textContent])"
    )
    warm = [fill for is_warm, fill, _ in marked if is_warm]
    assert 0 < len(warm) < 8
    assert all(fill != "none" for fill in warm)
    assert all(fill == "none" for is_warm, fill, _ in marked if not is_warm)
    assert all(title.startswith("line ") and title.endswith(" K") for _, _, title in marked)


def test_the_shown_values_are_the_recorded_ones(browser, pages):
    import numpy as np
    import xarray

    open_page(browser, pages["three"], 1280)
    with xarray.open_dataset(pages["three"].parent / "pi" / "results.nc") as results:
        at = results.sel(time=1800.0)
        expected = (at["supply_temperature"] - at["set_point"]).to_numpy()
    titles = browser.execute_script(
        "return Array.from(document.querySelectorAll('.view:last-child .line title'))"
        ".map(t => t.textContent)"
    )
    shown = [float(t.split(": ")[1].removesuffix(" K").replace("−", "-")) for t in titles]
    np.testing.assert_allclose(shown, expected, atol=0.006)


def test_play_moves_on_and_pauses(browser, pages):
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.ui import WebDriverWait

    open_page(browser, pages["three"], 1280)
    slider, play = browser.find_element("id", "moment"), browser.find_element("id", "play")
    slider.send_keys(Keys.HOME)
    play.send_keys(Keys.SPACE)
    assert "Pause" in play.text
    WebDriverWait(browser, 10).until(lambda _: int(slider.get_property("value")) >= 2)
    play.send_keys(Keys.SPACE)
    assert "Play" in play.text


def test_the_keyboard_reaches_the_controls_in_order(browser, pages):
    from selenium.webdriver.common.keys import Keys

    open_page(browser, pages["three"], 1280)
    play = browser.find_element("id", "play")
    play.send_keys(Keys.TAB)
    assert browser.switch_to.active_element.get_attribute("id") == "moment"
    browser.switch_to.active_element.send_keys(Keys.TAB)
    assert browser.switch_to.active_element.get_attribute("name") == "controller"


def test_a_thousand_lines_are_drawn_as_tiles(browser, pages):
    from selenium.webdriver.common.keys import Keys

    assert pages["thousand"].stat().st_size < 5_000_000
    open_page(browser, pages["thousand"], 1280)
    before = fills(browser)
    assert len(before) == 1000
    browser.find_element("id", "moment").send_keys(Keys.HOME)
    assert fills(browser) != before


def test_hostile_names_do_nothing(browser, tmp_path):
    names = [
        "</script><script>document.title='taken'</script>",
        "<img src=x onerror=alert(1)>",
        "&",
    ]
    page = write_report(
        comparison(tmp_path, n=3, names=names, controllers=["pi", "a b'\"&<i>"], step=60.0)
    )
    open_page(browser, page, 1280)
    assert browser.title == "cooling-row – key figures"
    assert browser.get_log("browser") == []
    titles = browser.find_elements("css selector", ".view:first-child .line title")
    assert names[0] in titles[0].get_attribute("textContent")


def test_without_scripts_the_figures_are_still_there(browser, pages):
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        open_page(browser, pages["three"], 1280)
        assert not browser.find_element("id", "controls").is_displayed()
        assert "needs scripts" in browser.find_element("css selector", "noscript").text
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
