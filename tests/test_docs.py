"""The documentation names what is there."""

import re
from pathlib import Path

import attrs
import pytest

import posmas_fmi
from posmas_fmi import cli
from posmas_fmi.scenario import tables

ROOT = Path(posmas_fmi.__file__).resolve().parent.parent
pytestmark = pytest.mark.skipif(
    not (ROOT / "docs").is_dir(), reason="the documentation is in the checkout only"
)


def words(name):
    return set(re.findall(r"[\w-]+", (ROOT / name).read_text(encoding="utf-8")))


@pytest.mark.parametrize(
    "table",
    [
        tables.ScenarioTable,
        tables.AgentTable,
        tables.NetworkTable,
        tables.PlantTable,
        tables.Port,
        tables.Override,
        tables.LeaderTable,
        tables.InitialTable,
        tables.ChannelTable,
        tables.ArcTable,
        tables.ReportTable,
        tables.ScenarioFile,
    ],
    ids=lambda table: table.__name__,
)
def test_every_key_of_a_scenario_is_explained(table):
    known = words("docs/scenario.md")
    assert {a.name for a in attrs.fields(table)} <= known


def test_the_readme_lists_the_commands_that_work_and_no_others(capsys):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^    posmas-fmi ([a-z]+)", readme.split("## All commands")[1], re.M))
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    helped = capsys.readouterr().out
    for name in re.findall(r"^    ([a-z]+) ", helped, re.M):
        assert (name in listed) == ("not in this version" not in _help(name, capsys)), name


def _help(name, capsys):
    with pytest.raises(SystemExit):
        cli.main([name, "--help"])
    return capsys.readouterr().out


def test_the_page_of_the_paper_has_every_entry_of_the_ledger():
    """Regenerate with the command that the page names."""
    from posmas_fmi.design.ledger import ledger

    page = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    for entry in ledger():
        erratum = f"(erratum {entry.erratum}) " if entry.erratum else ""
        assert f"[{entry.verdict}] {erratum}{entry.item}" in page


def test_links_of_the_documentation_lead_somewhere():
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]:
        for link in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert link.startswith("http") or (page.parent / link).exists(), f"{page.name}: {link}"
