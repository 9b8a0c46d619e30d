import os

import numpy as np
import pytest

from posmas_fmi import resources
from posmas_fmi.errors import InputError, PosmasError, ScenarioError
from posmas_fmi.scenario import load
from posmas_fmi.scenario.build import find, make_channel, shipped_scenarios

TEXT = (resources.shipped("models") / "paper_example_1.toml").read_text(encoding="utf-8")


def write(folder, text):
    path = folder / "case.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("path", shipped_scenarios(), ids=lambda path: path.stem)
def test_every_shipped_scenario_loads_by_name(path):
    scenario = load(path.stem)
    assert len(scenario.x0) == scenario.network.N
    assert scenario.name.replace("-", "_") == path.stem


# change of the file, places that must be named, words that must be there
MISTAKES = {
    "misspelt key": ("period =", "periode =", ["$.scenario.periode"], "did you mean period"),
    "misspelt table": ("[leader]", "[leeder]", ["$.leeder", "$.leader"], "did you mean leader"),
    "misspelt design key": ("phi = 10.0", "phy = 10.0", ["$.design.phy"], "did you mean phi"),
    "no point recorded": ("[leader]", "[record]\nevery = 0\n[leader]", ["$.record.every"], "1"),
    "unknown recorded": (
        *("[leader]", '[record]\nvariables = ["z"]\n[leader]', ["$.record.variables[0]"], "xhat"),
    ),
    "unknown method": ('"contraction"', '"magic"', ["$.design.method"], "contraction"),
    "text for a number": ("until = 10.0", 'until = "10"', ["$.scenario.until"], "number"),
    "NaN": ("[10.3, -9.84]", "[nan, -9.84]", ["$.agent.A[1][0]"], "finite"),
    "infinite period": ("period = 0.005", "period = inf", ["$.scenario.period"], "finite"),
    "not Metzler": ("[10.3, -9.84]", "[-10.3, -9.84]", ["$.agent.A[1][0]"], "Metzler"),
    "shape of C": ("C = [[0.7, -0.3], [0.1, 0.6]]", "C = [[0.7]]", ["$.agent.C"], "(q, m)"),
    "ragged A": ("[10.3, -9.84]", "[10.3]", ["$.agent.A[1]"], "first row"),
    "empty A": ("A = [[-10.18, 9.98], [10.3, -9.84]]", "A = []", ["$.agent.A"], "entry"),
    "negative B": ("B = [[0.7], [0.7]]", "B = [[-0.7], [0.7]]", ["$.agent.B[0][0]"], "negative"),
    "hostile g": ('"x1*sin(0.31*x1*t)"', "\"__import__('os')\"", ["$.agent.g[0]"], "__import__"),
    "unknown name in sec": ("1.2*u1", "1.2*v1", ["$.agent.sec[0]"], "v1"),
    "sector": ("[0.9, 1.2]", "[1.2, 0.9]", ["$.agent.sector"], "m_l"),
    "region": ("x = [0.0, 4.0]", "z = [0.0, 4.0]", ["$.agent.region.z"], "x1"),
    "arc to nowhere": ("[4, 2]", "[4, 7]", ["$.network.arcs[2]"], "1 to 4"),
    "arc of three words": ("[4, 2]", "[4, 2, 1, 1]", ["$.network.arcs[2]"], "weight"),
    "nobody pinned": ("pinned = [2]", "pinned = []", ["$.network.pinned"], "leader"),
    "pin beyond": ("pinned = [2]", "pinned = [9]", ["$.network.pinned[0]"], "1 to 4"),
    "unreached": (", [1, 4]", "", ["$.network"], "agent(s) 4"),
    "two sources": ("agents = 4", 'agents = 4\nfile = "a.csv"', ["$.network"], "either"),
    "no such file": ("agents = 4", 'agents = 4\nfile = "a.csv"', ["$.network"], "either"),
    "wrong s0": ("s0 = [1.0, 1.0]", "s0 = [1.0]", ["$.leader.s0"], "2 values"),
    "negative s0": ("s0 = [1.0, 1.0]", "s0 = [1.0, -1.0]", ["$.leader.s0"], "non-negative"),
    "initial": ("{uniform = [0.0, 2.0]}", "{uniform = [2.0, 0.0]}", ["$.initial.x.uniform"], "low"),
    "initial size": ("xhat = 0.0", "xhat = [1.0, 2.0, 3.0]", ["$.initial.xhat"], "2"),
    "initial of another FMU": (
        'fmu = "positive_agent"',
        'fmu = "mine.fmu"',
        ["$.initial.x"],
        "$.plant.parameters",
    ),
    "until": ("until = 10.0", "until = 10.001", ["$.scenario.until"], "multiple"),
    "name": ('"paper-example-1"', '"../up"', ["$.scenario.name"], "folder"),
    "fmi": ('fmu = "positive_agent"', 'fmu = "positive_agent"\nfmi = 1', ["$.plant.fmi"], "2 or 3"),
    "channel": ("[leader]", "[channel]\nloss = 2.0\n[leader]", ["$.channel.loss"], "[0, 1]"),
    "channel, twice": (
        "[leader]",
        "[channel]\nloss = 2.0\ndelay = -1.0\n[leader]",
        ["$.channel.delay", "$.channel.loss"],
        "expected a time >= 0 s (got -1.0)",
    ),
    "override": (
        "[leader]",
        "[[plant.override]]\nagent = 9\n[leader]",
        ["$.plant.override[0].agent"],
        "1 to 4",
    ),
    "two overrides": (
        "[leader]",
        2 * "[[plant.override]]\nagent = 3\n" + "[leader]",
        ["$.plant.override[1].agent"],
        "agent 3 is in $.plant.override[0] already",
    ),
    "two tables of an arc": (
        "[leader]",
        2 * "[[channel.arc]]\narc = [2, 1]\n" + "[leader]",
        ["$.channel.arc[1].arc"],
        "arc [2, 1] is in $.channel.arc[0] already",
    ),
    "not TOML": ("[scenario]", "[scenario", [], "TOML"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_each_mistake_is_one_clear_error_with_its_place(tmp_path, case):
    old, new, places, word = MISTAKES[case]
    assert old in TEXT
    with pytest.raises(InputError) as caught:
        load(write(tmp_path, TEXT.replace(old, new, 1)))
    message = str(caught.value)
    assert "case.toml" in message
    for place in places:
        assert f"{place}: " in message
    assert word in message
    assert caught.value.exit_code == 2


def test_all_mistakes_of_a_file_are_reported_at_once(tmp_path):
    text = TEXT.replace("[10.3, -9.84]", "[-10.3, -9.84]").replace("[4, 2]", "[4, 7]")
    text = text.replace("phi = 10.0", "phi = -1.0").replace("s0 = [1.0, 1.0]", "s0 = [-1.0, 1.0]")
    with pytest.raises(ScenarioError) as caught:
        load(write(tmp_path, text))
    places = {place for place, _ in caught.value.problems}
    assert places == {"$.agent.A[1][0]", "$.network.arcs[2]", "$.design.phi"}
    # what depends on agent and network can only be checked once those are right


def test_unknown_design_keys_are_reported_with_mistakes_of_form(tmp_path):
    text = TEXT.replace("phi = 10.0", "phy = 10.0").replace("[10.3, -9.84]", "[nan, -9.84]")
    with pytest.raises(ScenarioError) as caught:
        load(write(tmp_path, text))
    assert {place for place, _ in caught.value.problems} == {"$.agent.A[1][0]", "$.design.phy"}


@pytest.mark.parametrize(
    "content",
    [b"", b"\x00\x01\xff\xfe" * 100, b"\x7fELF" + bytes(1000), "x = \u2603".encode("utf-16")],
)
def test_what_is_no_scenario_is_one_clear_error(tmp_path, content):
    path = tmp_path / "case.toml"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load(str(path))
    assert str(path) in str(caught.value)


def test_a_folder_and_a_missing_file_are_named(tmp_path):
    with pytest.raises(InputError, match="got a folder"):
        load(str(tmp_path))
    with pytest.raises(InputError, match="no such file"):
        load(str(tmp_path / "missing.toml"))
    with pytest.raises(InputError, match="did you mean paper_example_1"):
        find("paper_exmple_1")


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root reads every file")
def test_an_unreadable_file_is_named(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(TEXT)
    path.chmod(0)
    with pytest.raises(InputError, match="cannot be read"):
        load(str(path))


def test_network_from_a_file_beside_the_scenario(tmp_path):
    (tmp_path / "net.csv").write_text("from,to\n2,1\n3,1\n4,2\n1,3\n2,3\n1,4\n")
    start, end = TEXT.index("agents = 4"), TEXT.index("pinned = [2]")
    scenario = load(write(tmp_path, TEXT[:start] + 'file = "net.csv"\n' + TEXT[end:]))
    reference = load("paper_example_1")
    np.testing.assert_array_equal(
        scenario.network.pinned_laplacian.toarray(), reference.network.pinned_laplacian.toarray()
    )
    assert [path.name for path in scenario.inputs] == ["net.csv"]


def test_initial_states_come_from_the_seed():
    first, again = load("paper_example_1"), load("paper_example_1")
    np.testing.assert_array_equal(first.x0, again.x0)
    other = load("paper_example_1", seed=7)
    assert (first.x0 != other.x0).any()
    assert (first.x0 >= 0).all()
    assert (first.x0 <= 2).all()


def test_options_replace_what_the_file_says():
    scenario = load("paper_example_1", period=0.01, until=2.0)
    assert (scenario.clock.h, scenario.clock.steps) == (0.01, 200)


def test_single_arcs_of_the_channel(tmp_path):
    text = TEXT + (
        "\n[channel]\nloss = 0.1\n[[channel.arc]]\narc = [4, 2]\ndelay = 0.012\n"
        "[[channel.arc]]\narc = [0, 2]\nloss = 0.5\njitter = 0.0\n"
    )
    scenario = load(write(tmp_path, text))
    channel = make_channel(scenario.channel, scenario.network, scenario.clock.h)
    # rows of the adjacency: 1 hears 2, 3; 2 hears 4; 3 hears 1, 2; 4 hears 1; then the leader
    np.testing.assert_array_equal(channel.delay, [0, 0, 3, 0, 0, 0, 0])
    np.testing.assert_allclose(channel.loss, [0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.5])
    with pytest.raises(PosmasError, match="no arc from 2 to 4"):
        load(write(tmp_path, TEXT + "\n[[channel.arc]]\narc = [2, 4]\n"))
