"""The documentation names what is there."""

import json
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import attrs
import pytest

import posmas_fmi
from posmas_fmi import cli
from posmas_fmi.design import design
from posmas_fmi.scenario import tables

ROOT = Path(posmas_fmi.__file__).resolve().parent.parent
pytestmark = pytest.mark.skipif(
    not (ROOT / "docs").is_dir(), reason="the documentation is in the checkout only"
)


@pytest.fixture(scope="module")
def generated():
    return runpy.run_path(str(ROOT / "docs" / "generate.py"))


def test_every_key_of_a_scenario_is_explained(generated):
    for table in generated["scenario_tables"]():
        for key in table.keys:
            assert key.meaning, (
                f"say what {key.name!r} of {table.path} means: in the docstring of "
                f"{table.place.__module__}.{table.place.__name__}, section Attributes"
            )


def test_the_page_of_keys_has_every_table_that_a_file_is_read_into(generated):
    shown = {table.place for table in generated["scenario_tables"]()}
    there = {c for c in vars(tables).values() if isinstance(c, type) and attrs.has(c)}
    assert there - {tables.ScenarioFile} <= shown
    paths = [table.path for table in generated["scenario_tables"]()]
    for path in ("[plant]", "[[plant.override]]", "{variable = …}", "[signals.NAME]"):
        assert path in paths


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
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    for page in pages:
        for link in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert link.startswith("http") or (page.parent / link).exists(), f"{page.name}: {link}"


def test_pages_made_from_the_code_are_up_to_date(generated):
    assert {"commands.md", "scenario_keys.md"} <= set(generated["PAGES"])
    for page, make in generated["PAGES"].items():
        stored = (ROOT / "docs" / page).read_text(encoding="utf-8")
        assert make() == stored, f"{page} is old: python docs/generate.py"


@pytest.mark.parametrize("page", ["README.md", "docs/index.md", "docs/tutorial.md"])
def test_commands_of_the_guides_are_understood(page):
    text = (ROOT / page).read_text(encoding="utf-8").split("## All commands")[0]
    lines = re.findall(r"^(?:    )?(posmas-fmi (?!: )[a-z].*)$", text, re.M)
    assert lines or page == "docs/index.md"
    for line in lines:
        cli._parser().parse_args(shlex.split(line.partition("#")[0])[1:])


def test_the_scenario_of_the_tutorial_runs(tmp_path):
    text = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    example = re.search(r"```toml\n(\[scenario\].*?)```", text, re.S).group(1)
    path = tmp_path / "tanks.toml"
    path.write_text(example, encoding="utf-8")
    result = posmas_fmi.run(posmas_fmi.load(path), tmp_path / "out", report=False)
    assert result.summary["verdict"] == "converged"
    assert result.design.certificate.certified == "yes"
    path.write_text(example.replace("period = 0.1 ", "period = 20.0 "), encoding="utf-8")
    slow = posmas_fmi.load(path)
    made = design(slow.agent, slow.network, slow.design, slow.clock.h)
    assert 4.2 < result.design.certificate.rate < 4.3
    assert 0.2 < made.certificate.rate < 0.23


def test_every_promise_about_fmus_names_tests_that_are_there():
    """The page of promises: each row names tests or hostile FMUs, and all of them exist."""
    import hostile

    page = (ROOT / "docs" / "master.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (?!promise)(.+) \| (.+) \|$", page, re.M)
    assert len(rows) > 80
    defects = {defect.name for defect in hostile.DEFECTS}
    for promise, shown in rows:
        names = re.findall(r"`([^`]+)`", shown)
        assert names, promise
        assert shown == ", ".join(f"`{name}`" for name in names), promise
        for name in names:
            if name.startswith("hostile: "):
                assert name.removeprefix("hostile: ") in defects, f"{promise}: {name}"
                continue
            file, _, test = name.partition("::")
            code = (ROOT / "tests" / file).read_text(encoding="utf-8")
            assert re.search(rf"^def {test}\(", code, re.M), f"{promise}: {name}"


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_fetches_nothing(tmp_path):
    site = tmp_path / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)}
    made = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        fetched = re.findall(r'<(?:script|img|iframe)[^>]* src="(https?:[^"]*)"', text)
        fetched += re.findall(
            r'<link[^>]* rel="(?:stylesheet|preconnect)"[^>]*href="(https?:[^"]*)"', text
        )
        assert fetched == [], page.name
    reference = "".join(p.read_text(encoding="utf-8") for p in (site / "api").glob("*.html"))
    for name in posmas_fmi.__all__:
        assert re.search(rf'id="posmas_fmi\.[\w.]*\b{name}"', reference), name


def test_the_short_scenario_of_the_page_is_whole(tmp_path):
    text = (ROOT / "docs" / "scenario.md").read_text(encoding="utf-8")
    path = tmp_path / "tanks.toml"
    path.write_text(re.search(r"```toml\n(.*?)```", text, re.S).group(1), encoding="utf-8")
    assert posmas_fmi.load(path).network.N == 3


def test_the_controller_of_the_page_runs_and_its_failure_is_told(tmp_path, capsys):
    text = (ROOT / "docs" / "scenario.md").read_text(encoding="utf-8")
    short, law = (re.search(rf"```{kind}\n(.*?)```", text, re.S)[1] for kind in ("toml", "python"))
    path, out = tmp_path / "tanks.toml", tmp_path / "out"
    path.write_text(
        f'{short}\n[control]\npython = "follow.py:Follow"\nparameters = {{gain = 4.0}}\n'
        "[report]\nbaseline = false\n",
        encoding="utf-8",
    )
    (tmp_path / "follow.py").write_text(law, encoding="utf-8")
    made = posmas_fmi.run(posmas_fmi.load(path, until=10.0), out)
    assert made.summary["verdict"] == "converged"
    assert made.design.certificate.certified == "yes"
    assert made.certified == json.loads((out / "design.json").read_text())["certified"] == "no"
    (uncovered,) = made.summary["coverage"]
    assert not uncovered["covered"]
    law = law.replace("target = ", "t > 0.95 and 1 / 0\n        target = ")
    (tmp_path / "follow.py").write_text(law, encoding="utf-8")
    assert cli.main(["run", str(path), "--out", str(out)]) == 2
    assert "step of agent 1 at t = 1 s: ZeroDivisionError" in capsys.readouterr().err
    assert cli.main(["report", str(out)]) == 0
    assert "cut off at t = 0.9 s" in (out / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("block", range(4))
def test_the_tables_of_the_scenario_page_are_known(block, generated):
    import tomllib

    text = (ROOT / "docs" / "scenario.md").read_text(encoding="utf-8")
    example = tomllib.loads(re.findall(r"```toml\n(.*?)```", text, re.S)[block])
    keys = {
        table.path.strip("[]").removesuffix(".NAME"): {key.name for key in table.keys}
        for table in generated["scenario_tables"]()
    }
    for name, content in example.items():
        tables_of = content if isinstance(content, list) else [content]
        if name == "signals":
            tables_of = list(content.values())
        for table in tables_of:
            below = {path.partition(".")[2] for path in keys if path.startswith(f"{name}.")}
            assert set(table) <= keys[name] | below
