import json
import os
import socket
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from fmu_examples import tank_fmu

from posmas_fmi import resources
from posmas_fmi.cli import main
from posmas_fmi.fmu.build import fmu
from posmas_fmi.fmu.plant import read_plant

SHORT = ["run", "paper_example_1", "--until", "0.1"]


def test_run_prints_its_verdict_and_writes_its_folder(tmp_path, capsys):
    code = main([*SHORT, "--out", str(tmp_path / "a"), "--json"])
    printed = json.loads(capsys.readouterr().out)
    assert printed["certified"] == "conditional"
    assert (tmp_path / "a" / "report.html").is_file()
    # 0.1 s is too short to converge: a negative verdict
    assert (code, printed["verdict"]) == (1, "not converged")


def test_the_default_folder_is_named_after_the_scenario(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main(SHORT)
    assert (tmp_path / "out" / "paper-example-1" / "results.nc").is_file()
    assert "out/paper-example-1/report.html" in capsys.readouterr().out.replace("\\", "/")


@pytest.mark.parametrize(
    ("name", "code"),
    [("paper_example_1", 0), ("paper_example_1_printed", 1), ("paper_example_2_printed", 1)],
)
def test_exit_codes_of_the_main_job(tmp_path, capsys, name, code):
    assert main(["run", name, "--out", str(tmp_path)]) == code
    assert capsys.readouterr().err == ""


def test_design_prints_the_contract(capsys):
    assert main(["design", "paper_example_1_tanh", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["certified"] == "yes"
    for key in ("method", "K", "E", "assumptions", "rate", "observer_rate", "positive", "pinned"):
        assert key in printed
    assert {"name", "holds", "margin", "proof"} <= set(printed["conditions"][0])
    assert {"name", "status", "detail"} <= set(printed["assumptions"][0])


def test_certify_judges_given_gains(tmp_path, capsys):
    gains = tmp_path / "gains.json"
    gains.write_text('{"K": [[-0.441, -0.441]], "E": [[-0.1724, 3.7982], [3.7982, 3.0183]]}')
    assert main(["certify", "paper_example_1", "--gains", str(gains), "--json"]) in (0, 1)
    printed = json.loads(capsys.readouterr().out)
    assert printed["K"] == [[-0.441, -0.441]]
    gains.write_text('{"K": [[0.441, 0.441]], "E": [[0.0, 9.0], [0.0, 9.0]]}')
    assert main(["certify", "paper_example_1", "--gains", str(gains)]) == 1
    assert "REFUTED" in capsys.readouterr().out


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", '{"K": 1}', '{"K": "a", "E": "b"}', '{"K": [[1]], "E": [[1]]}']
)
def test_certify_refuses_what_are_no_gains(tmp_path, capsys, content):
    gains = tmp_path / "gains.json"
    gains.write_text(content)
    assert main(["certify", "paper_example_1", "--gains", str(gains)]) == 2
    assert capsys.readouterr().err.startswith("posmas-fmi: ")


def test_paper_prints_the_ledger(capsys):
    assert main(["paper", "--json"]) == 0
    entries = json.loads(capsys.readouterr().out)["entries"]
    assert {"reproduced", "rounded", "contradicted", "infeasible"} == {
        entry["verdict"] for entry in entries
    }
    assert main(["paper"]) == 0
    counts = [sum(e["verdict"] == v for e in entries) for v in ("reproduced", "contradicted")]
    assert f"{counts[0]} reproduced" in capsys.readouterr().out


def test_pins_are_placed_where_the_scenario_leaves_them_open(tmp_path, capsys):
    text = (resources.shipped("models") / "paper_example_1.toml").read_text(encoding="utf-8")
    path = tmp_path / "auto.toml"
    path.write_text(text.replace("pinned = [2]", "pinned = {count = 2}"), encoding="utf-8")
    assert main(["design", str(path), "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["pinned"] == ["2", "4"]
    assert "best of all choices" in made["notes"][0]
    gains = tmp_path / "gains.json"
    gains.write_text(json.dumps({"K": made["K"], "E": made["E"]}))
    assert main(["certify", str(path), "--gains", str(gains), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rate"] == made["rate"]
    path.write_text(text.replace("pinned = [2]", 'pinned = "auto"'), encoding="utf-8")
    assert main(["design", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pinned"] == ["2"]


def test_errors_that_come_late_name_the_file_as_well(tmp_path, capsys, monkeypatch):
    text = (resources.shipped("models") / "paper_example_1.toml").read_text(encoding="utf-8")
    path = tmp_path / "mine.toml"
    path.write_text(text.replace('"u[1]"', '{variable = "u[1]", unit = "K"}'), encoding="utf-8")
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith(f"posmas-fmi: {path}: $.plant.inputs: ")

    def too_much(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 33 GiB")

    monkeypatch.setattr("posmas_fmi.cosim.engine.run", too_much)
    assert main(["run", "paper_example_1", "--out", str(tmp_path / "out")]) == 2
    assert "not enough memory (Unable to allocate 33 GiB); fewer" in capsys.readouterr().err


def test_report_is_made_again_from_what_is_stored(tmp_path, capsys):
    main([*SHORT, "--out", str(tmp_path)])
    first = (tmp_path / "report.html").read_bytes()
    (tmp_path / "report.html").unlink()
    assert main(["report", str(tmp_path)]) == 0
    assert (tmp_path / "report.html").read_bytes() == first
    assert main(["report", str(tmp_path / "nothing")]) == 2
    capsys.readouterr()


def test_models_lists_what_ships(capsys):
    assert main(["models"]) == 0
    printed = capsys.readouterr().out
    for path in resources.shipped("models").glob("*.toml"):
        assert path.stem in printed


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "paper_exmple_1"],
        ["run", "missing.toml"],
        ["run", "."],
        ["design", "missing.toml"],
        ["certify", "paper_example_1", "--gains", "missing.json"],
        ["run", "paper_example_1", "--until", "0.0001"],
        ["run", "paper_example_1", "--seed", "-1"],
        ["run", "paper_example_1", "--at", "1"],
        ["check", "some.fmu"],
        ["linearise", "some.fmu", "--in", "u", "--out", "y"],
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(capsys, arguments):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("posmas-fmi: ")
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["dance"],
        ["run"],
        ["run", "paper_example_1", "--until", "-3"],
        ["linearise", "some.fmu", "--in", "u"],
        ["linearise", "some.fmu", "--in", "u", "--out", "y", "--at", "nan"],
        ["linearise", "some.fmu", "--in", "u", "--out", "y", "--set", "A=many"],
        ["design", "x", "--method", "y"],
    ],
)
def test_bad_arguments_are_exit_code_2(capsys, arguments):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "usage:" in capsys.readouterr().err


def test_linearise_prints_the_linear_model(tmp_path, capsys):
    path = tank_fmu(tmp_path, 2)
    command = ["linearise", str(path), "--in", "power", "--out", "net", "--out", "flow"]
    assert main([*command, "--at", "20", "--set", "loss=4", "power=50", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["A"] == [[pytest.approx(-0.08)]]
    assert printed["B"] == [[pytest.approx(0.02)]]
    assert printed["D"] == [[pytest.approx(1.0)], [pytest.approx(0.0)]]
    assert printed["method"] == "directional derivatives"
    assert printed["metzler"]["metzler"] is True
    assert printed["poles"] == [[pytest.approx(-0.08), 0.0]]
    assert main(command) == 0
    shown = capsys.readouterr().out
    for line in ("temperature = 300", "continuous", "-0.04 (stable)", "Metzler    yes"):
        assert line in shown


def test_a_linear_model_of_no_use_is_a_negative_verdict(tmp_path, capsys):
    tank_fmu(tmp_path, 2)
    folder = tmp_path / "tank"
    text = (folder / "model.c").read_text(encoding="utf-8")
    text = text.replace(
        "x[0] - 290.0)) / 50.0;", "x[0] - 290.0)) / 50.0 + 100.0 * sin(1e6 * x[0]);"
    )
    (folder / "model.c").write_text(f"#include <math.h>\n{text}", encoding="utf-8")
    path = fmu(read_plant(folder), 2, cache=tmp_path)
    command = [str(path), "--in", "power", "--out", "temperature"]
    assert main(["linearise", *command]) == 1
    assert "of no use" in capsys.readouterr().out
    assert main(["linearise", *command, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["useful"] is False
    assert main(["fit", *command, "--region", "x=-1:1", "u=-1:1"]) == 1
    assert "# Verdict: of no use" in capsys.readouterr().out


def test_fit_prints_sections_that_a_scenario_takes(tmp_path, capsys):
    path = tank_fmu(tmp_path, 2)
    command = ["fit", str(path), "--in", "power", "--out", "temperature"]
    region = ["--set", "temperature=340", "--region", "x=-10:10", "u=-50:50"]
    assert main([*command, *region]) == 0
    printed = capsys.readouterr().out
    for line in ("# Metzler: yes", "# Residual: ", "# Sector of power: sec(u)/u in [1, 1]"):
        assert line in printed
    head = '[scenario]\nname = "tank"\nuntil = 1.0\nperiod = 0.1\n'
    head += "[network]\nagents = 2\narcs = [[1, 2]]\npinned = [1]\n[leader]\ns0 = [0.0]\n"
    scenario = tmp_path / "tank.toml"
    scenario.write_text(head + printed, encoding="utf-8")
    assert main(["design", str(scenario), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["certified"] == "yes"
    assert main([*command, *region, "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["A"] == [[pytest.approx(-0.04)]]
    assert made["toml"] in printed
    assert made["useful"] is True
    # without a region a tenth either side
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "x1 = [-30.0, 30.0]" in printed
    assert "no region was given" in printed


def test_fit_refuses_what_is_no_region(tmp_path, capsys):
    path = tank_fmu(tmp_path, 2)
    command = ["fit", str(path), "--in", "power", "--out", "temperature", "--region"]
    for text in ("x=1", "x", "=1:2", "x=a:b", "x=2:1", "x=nan:1", "v=0:1", "x=0:1"):
        try:
            code = main([*command, text])
        except SystemExit as caught:
            code = caught.code
        assert code == 2, text
        assert "region" in capsys.readouterr().err


def test_linearise_tells_bad_names_from_bad_fmus(tmp_path, capsys):
    path = tank_fmu(tmp_path, 2)
    assert main(["linearise", str(path), "--in", "powr", "--out", "net"]) == 2
    assert "did you mean 'power'?" in capsys.readouterr().err
    broken = tmp_path / "broken.fmu"
    broken.write_bytes(path.read_bytes()[:100])
    assert main(["linearise", str(broken), "--in", "power", "--out", "net"]) == 3
    # a power that is no number is refused by the FMU
    assert (
        main(
            [
                "linearise",
                str(path),
                "--in",
                "power",
                "--out",
                "net",
                "--set",
                "power=1e308",
                "loss=-1e308",
            ]
        )
        == 3
    )
    assert "tank" in capsys.readouterr().err


def test_help_imports_nothing_heavy():
    code = (
        "import sys, contextlib, io\n"
        "from posmas_fmi.cli import main\n"
        "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n"
        "    main(['--help'])\n"
        "heavy = {'numpy', 'sympy', 'scipy', 'cvxpy', 'control', 'matplotlib', 'fmpy'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_design_by_contraction_imports_no_solver_of_lmis():
    code = (
        "import sys\n"
        "from posmas_fmi.cli import main\n"
        "main(['design', 'paper_example_1', '--json'])\n"
        "print(sorted({'cvxpy', 'matplotlib', 'fmpy', 'control'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("fmi", [2, 3])
def test_check_takes_a_path_from_where_one_is(fmi, tmp_path, monkeypatch, capsys):
    path = tank_fmu(tmp_path, fmi)
    monkeypatch.chdir(tmp_path)
    assert main(["check", path.name, "--in", "power", "--out", "temperature"]) == 0
    assert capsys.readouterr().out.startswith(path.name)


def test_check_prints_facts_findings_and_a_verdict(tmp_path, capsys):
    path = tank_fmu(tmp_path, 2)
    assert main(["check", str(path), "--in", "power", "--out", "net", "temperature"]) == 0
    printed = capsys.readouterr().out
    assert "power [W]" in printed
    assert printed.splitlines()[-1].startswith("fine: 0 errors")
    bad = tmp_path / "bad.fmu"
    bad.write_bytes(path.read_bytes()[:1000])
    assert main(["check", str(path), str(bad), "--json"]) == 3
    good, broken = json.loads(capsys.readouterr().out)["fmus"]
    assert (good["verdict"], broken["verdict"]) == ("fine", "not usable")
    assert good["inputs"][0]["unit"] == "W"
    (finding,) = broken["findings"]
    assert (finding["severity"], finding["code"]) == ("fatal", "archive-damaged")
    assert main(["check", str(bad)]) == 3
    assert "fatal    archive-damaged: expected a zip" in capsys.readouterr().out


def test_an_error_that_leaves_an_fmu_usable_is_exit_code_1(tmp_path, capsys):
    path = tank_fmu(tmp_path, 2)
    one = tmp_path / "one.fmu"
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(one, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            if name == "modelDescription.xml":
                data = data.replace(b'name="net"', b'name="net&#x9b;31m"')
                data = data.replace(b'start="100.0"', b'start="NaN"')
            target.writestr(name, data)
    assert main(["check", str(one)]) == 1
    printed = capsys.readouterr().out
    assert "error    start-not-finite: power" in printed
    assert "outputs         net\\x9b31m [W]" in printed  # no control sequence gets through
    assert printed.splitlines()[-1].startswith("usable, with errors: 1 error")


@pytest.mark.parametrize("arguments", [["missing.fmu"], ["TANK", "--in", "pwer"]])
def test_check_of_what_is_not_there_is_bad_input(tmp_path, capsys, arguments):
    path = tank_fmu(tmp_path, 2)
    assert main(["check", *(str(path) if a == "TANK" else a for a in arguments)]) == 2
    said = capsys.readouterr().err
    assert "no such file" in said or "did you mean 'power'" in said


def test_check_of_what_cannot_be_read_is_bad_input(tmp_path, capsys, monkeypatch):
    """A file without permission was a damaged archive; a pipe must not be waited for."""
    good = tank_fmu(tmp_path, 2)
    empty, pipe, socket_ = (tmp_path / f"{n}.fmu" for n in ("empty", "pipe", "socket"))
    empty.touch()
    os.mkfifo(pipe)
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(socket_))
    for path, told in (
        (empty, "the file is empty"),
        (pipe, "no regular file"),
        (socket_, "no regular file"),
        (Path("/dev/zero"), "no regular file"),
        (tmp_path, "this is a folder"),
        (tmp_path / ("x" * 300), "File name too long"),
    ):
        assert main(["check", str(path)]) == 2
        assert told in capsys.readouterr().err
    # root may read everything, so that a mode would show nothing where tests run as root

    def refused(self, *given, **named):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", refused)
    assert main(["check", str(good)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(good) in line
    assert "permission denied" in line


def test_the_text_of_a_design_tells_baseline_band_and_region(tmp_path, capsys):
    path = tmp_path / "asked.toml"
    text = (resources.shipped("models") / "paper_example_1_tanh.toml").read_text(encoding="utf-8")
    asked = "[design]\nsaturation = 2.0\ndisturbance = [0.05, 0.05]"
    path.write_text(text.replace("[design]", asked, 1), encoding="utf-8")
    assert main(["design", str(path)]) == 0
    printed = capsys.readouterr().out
    for words in ("with K = 0", "attracted from |delta| <= ", "at most 1: 0.", "covers: arbitrary"):
        assert words in printed


@pytest.mark.parametrize(
    "frees",
    [
        "Freed(); time.sleep(600)",
        "Freed()\n    while True: pass",
        "Freed(); Freed(); Freed(); time.sleep(600)",  # it is swallowed again, and again
        "pause()",
    ],
)
def test_ctrl_c_while_an_object_is_freed_is_not_lost(frees):
    code = (
        "import time\n"
        "from posmas_fmi.cli import keep_interrupts\n"
        "class Freed:\n"
        "    def __del__(self):\n"
        "        raise KeyboardInterrupt\n"
        "def pause(depth=3):\n"
        "    Freed()\n"
        "    pause(depth - 1) if depth else time.sleep(600)\n"
        "keep_interrupts()\n"
        "try:\n"
        f"    {frees}\n"
        "except KeyboardInterrupt:\n"
        "    print('came')\n"
        "time.sleep(0)\n"  # and once only
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300
    )
    assert (done.stdout.strip(), done.stderr) == ("came", "")
