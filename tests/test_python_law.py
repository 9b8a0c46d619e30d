"""Controllers written in Python: the documented interface, and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest

from posmas_fmi import resources
from posmas_fmi.agent import linear_agent
from posmas_fmi.cosim import engine
from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.conditions import Episode
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import System, simulate
from posmas_fmi.cosim.plant import ModelPlant
from posmas_fmi.cosim.python_law import PythonLaw, load_class, make
from posmas_fmi.errors import InputError
from posmas_fmi.network import network_from_arcs
from posmas_fmi.protocol import make_protocol

AGENT = linear_agent([[-1.0]], [[1.0]], [[1.0]])
NETWORK = network_from_arcs(3, [(1, 2), (2, 3), (3, 1), (1, 3)], [1])


def system(law: Any, **channel: float) -> System:
    arcs = NETWORK.adjacency.nnz + 1
    return System(
        AGENT,
        NETWORK,
        law,
        Channel.uniform(arcs, 0.1, **channel),
        Clock.of(3.0, 0.1),
        np.zeros((3, 1)),
        np.ones(1),
    )


def rows_of(law: Any, **channel: float) -> dict[str, np.ndarray]:
    rows: dict[str, list[np.ndarray]] = {}

    def record(t: float, values: dict[str, np.ndarray]) -> None:
        for name, value in values.items():
            rows.setdefault(name, []).append(value.copy())

    plant = ModelPlant(AGENT, np.array([[2.0], [0.0], [1.0]]), rtol=1e-8)
    assert simulate(system(law, **channel), plant, record).ended == "complete"
    return {name: np.array(value) for name, value in rows.items()}


class Equation6:
    """Equation (6) of an agent whose state is its output, without an observer."""

    def __init__(self, degree: int) -> None:
        self.degree = degree

    def step(self, t: float, y: np.ndarray, neighbours: np.ndarray, s: Any) -> np.ndarray:
        assert len(neighbours) == self.degree
        disagreement = (y - neighbours).sum(axis=0) + (0.0 if s is None else y - s)
        return -0.5 * disagreement


@pytest.mark.parametrize("delay", [0.0, 0.2])
def test_equation_6_written_by_hand_is_the_protocol_with_a_dead_beat_observer(delay: float) -> None:
    """With y = x sent instead of the estimate: the same u at the first point, and consensus."""
    by_hand = PythonLaw(AGENT, NETWORK, [Equation6(d) for d in (1, 1, 2)])
    rows = rows_of(by_hand, delay=delay)
    x0, s = np.array([2.0, 0.0, 1.0]), 1.0
    expected = -0.5 * np.array([(2 - 1) + (2 - s), 0.0 - 2, (1 - 0) + (1 - 2)])
    np.testing.assert_allclose(rows["u"][0, :, 0], expected)
    np.testing.assert_allclose(rows["xhat"][1:, :, 0], rows["y"][:-1, :, 0])  # best guess from y
    spread = np.ptp(rows["x"][:, :, 0], axis=1)
    assert spread[-1] < 0.05 * spread[0]
    protocol = ProtocolLaw(AGENT, make_protocol(NETWORK, [[-0.5]], [[0.0]], 1.0))
    assert engine.choose(protocol).engine == "c"
    with pytest.raises(InputError, match="in C"):
        engine.choose(by_hand, "c")
    assert x0.shape == (3,)


def test_messages_are_what_a_controller_says() -> None:
    heard = []

    class Chatty:
        def __init__(self, number: int) -> None:
            self.number = number

        def message(self, t: float, y: np.ndarray) -> list[float]:
            return [10.0 * self.number, t]

        def step(self, t: float, y: np.ndarray, neighbours: np.ndarray, s: Any) -> float:
            heard.append((self.number, t, neighbours.tolist(), None if s is None else s.tolist()))
            return 0.0

    rows_of(PythonLaw(AGENT, NETWORK, [Chatty(k) for k in (1, 2, 3)]))
    assert heard[0] == (1, 0.0, [[30.0, 0.0]], [1.0])
    assert heard[1] == (2, 0.0, [[10.0, 0.0]], None)
    assert [row[2] for row in heard if row[0] == 3][1] == [[10.0, 0.1], [20.0, 0.1]]


def test_one_controller_for_all() -> None:
    class Central:
        def step_all(self, t: float, Y: np.ndarray, s: np.ndarray) -> np.ndarray:
            return 2.0 * (s - Y)

    rows = rows_of(PythonLaw(AGENT, NETWORK, Central()))
    np.testing.assert_allclose(rows["u"], 2.0 * (rows["s"][:, None] - rows["y"]))


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        ([1.0, 2.0], r"expected 1 number \(got \[1.0, 2.0\]\)"),
        ("x", "expected 1 number .got 'x'"),
        (None, "expected 1 number .got None: is there a return"),
        (np.nan, "expected 1 number, finite .got nan"),
    ],
)
def test_answers_that_are_no_input_name_agent_and_time(answer: Any, told: str) -> None:
    class Wrong:
        def step(self, t: float, *_: Any) -> Any:
            return answer if t > 0.15 else 0.0

    with pytest.raises(InputError, match="step of agent 1 at t = 0.2 s: " + told):
        rows_of(PythonLaw(AGENT, NETWORK, [Wrong()] * 3))
    with pytest.raises(InputError, match=r"control.python: step_all at t = 0.2 s: expected 3 num"):
        rows_of(PythonLaw(AGENT, NETWORK, All(Wrong())))


class All:
    def __init__(self, one: Any) -> None:
        self.one = one

    def step_all(self, t: float, Y: np.ndarray, s: Any) -> Any:
        answer = self.one.step(t)
        return np.zeros(3) if answer == 0.0 else answer


@pytest.mark.parametrize("error", ["1 / 0", "raise SystemExit(0)", "{}['a']"])
def test_what_a_controller_raises_names_agent_time_and_line(tmp_path: Path, error: str) -> None:
    text = f"""
class Mine:
    def __init__(self, number, fails):
        self.number, self.fails = number, fails
        if number == fails == 1:
            {error}

    def step(self, t, y, neighbours, s):
        if self.number == self.fails and t > 0.15:
            {error}
        return 0.0
"""
    (tmp_path / "mine.py").write_text(text)
    kind = {"1": "ZeroDivisionError", "r": "SystemExit", "{": "KeyError"}[error[0]]
    made = load_class("mine.py:Mine", tmp_path)
    with pytest.raises(InputError, match=rf"cannot be made: {kind}.*\(mine.py, line 6\)"):
        make(made, 1, fails=1)
    with pytest.raises(InputError, match=r"cannot be made: TypeError: .*'fials'"):
        make(made, 1, fials=1)
    law = PythonLaw(AGENT, NETWORK, [make(made, k, fails=2) for k in (1, 2, 3)])
    told = rf"step of agent 2 at t = 0.2 s: {kind}.*\(mine.py, line 10\)"
    with pytest.raises(InputError, match=told):
        rows_of(law)
    (tmp_path / "mine.py").write_text(f"import math\n{error}\n")
    with pytest.raises(InputError, match=rf"mine.py cannot be run: {kind}.*\(mine.py, line 2\)"):
        load_class("mine.py:Mine", tmp_path)


def test_arguments_are_checked_before_anything_runs() -> None:
    class Short:
        def step(self, t: float, y: np.ndarray) -> float:
            return 0.0

    class Silent:
        def step(self, t: float, y: np.ndarray, neighbours: np.ndarray, s: Any) -> float:
            return 0.0

        def message(self, y: np.ndarray) -> float:
            return 0.0

    for kind, told in (
        (Short, r"step\(t, y, neighbours, s\), self not counted \(got step\(t: .*, y: "),
        (Silent, r"message\(t, y\), self not counted \(got message\(y: "),
    ):
        with pytest.raises(InputError, match=told):
            PythonLaw(AGENT, NETWORK, [kind(), kind(), kind()])


@pytest.mark.parametrize("answer", [[1.0, 2.0], np.nan, None])
def test_messages_that_are_none_name_agent_and_time(answer: Any) -> None:
    class Chatty:
        def message(self, t: float, y: np.ndarray) -> Any:
            return answer if t > 0.15 else y

        def step(self, *_: Any) -> float:
            return 0.0

    with pytest.raises(InputError, match=r"message of agent 1 at t = 0.2 s: expected 1"):
        rows_of(PythonLaw(AGENT, NETWORK, [Chatty()] * 3))


def test_each_is_asked_when_its_period_begins_and_only_then() -> None:
    """Also one that all share; the time of messages is that of the communication point."""
    asked: list[tuple[int, float]] = []
    told: list[float] = []

    class Counting:
        def __init__(self, number: int) -> None:
            self.number = number

        def message(self, t: float, y: np.ndarray) -> np.ndarray:
            told.append(t)
            return y

        def step(self, t: float, *_: Any) -> float:
            asked.append((self.number, t))
            return 0.0

        def step_all(self, t: float, *_: Any) -> np.ndarray:
            asked.append((0, t))
            return np.zeros(3)

    every = np.array([2, 3, 2])
    for controllers in ([Counting(k) for k in (1, 2, 3)], Counting(0)):
        law = PythonLaw(AGENT, NETWORK, controllers, every)
        definition = attrs.evolve(system(law), clock=Clock.of(0.6, 0.1), every=every)
        simulate(definition, ModelPlant(AGENT, np.ones((3, 1))))
    of_each = {k: [t for number, t in asked if number == k] for k in range(4)}
    assert of_each[1] == of_each[3] == [0.0, 0.2, 0.4, 0.6]
    assert of_each[2] == [0.0, 0.3, 0.6]
    assert of_each[0] == [0.0, 0.2, 0.3, 0.4, 0.6]
    assert told[::3] == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]


def test_an_arc_that_is_off_is_not_heard() -> None:
    heard: dict[tuple[float, int], tuple[int, bool]] = {}

    class Listening:
        def __init__(self, number: int) -> None:
            self.number = number

        def step(self, t: float, y: np.ndarray, neighbours: np.ndarray, s: Any) -> float:
            heard[t, self.number] = len(neighbours), s is not None
            return 0.0

    law = PythonLaw(AGENT, NETWORK, [Listening(k) for k in (1, 2, 3)])
    numbers = NETWORK.arc_numbers()
    off = [numbers[1, 3], numbers[0, 1]]
    definition = attrs.evolve(system(law), episodes=(Episode("arc_off", off, 1.0, 1, 2),))
    simulate(definition, ModelPlant(AGENT, np.ones((3, 1))))
    of_all = [[heard[t, k] for k in (1, 2, 3)] for t in (0.0, 0.1, 0.2)]
    assert of_all[0] == of_all[2] == [(1, True), (1, False), (2, False)]
    assert of_all[1] == [(1, False), (1, False), (1, False)]


def test_controllers_that_are_none() -> None:
    with pytest.raises(InputError, match="3 controllers"):
        PythonLaw(AGENT, NETWORK, [Equation6(1)])
    with pytest.raises(InputError, match="step\\(t, y"):
        PythonLaw(AGENT, NETWORK, [object()] * 3)
    with pytest.raises(InputError, match="step_all"):
        PythonLaw(AGENT, NETWORK, object())


def test_classes_from_files(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("class Mine:\n    answer = 42\n")
    (tmp_path / "bad.py").write_text("1 / 0\n")
    assert load_class("mine.py:Mine", tmp_path).answer == 42
    for text, message in (
        ("mine.py:Other", "no class 'Other'"),
        ("mine.py", "file.py:Class"),
        ("none.py:Mine", "beside the scenario"),
        ("bad.py:Mine", "ZeroDivisionError"),
    ):
        with pytest.raises(InputError, match=message):
            load_class(text, tmp_path)


def test_what_a_controller_prints_is_not_in_the_results(tmp_path: Path) -> None:
    """Nor what it tells file descriptor 1."""
    (tmp_path / "mine.py").write_text(
        "import os\nclass Mine:\n    def __init__(self, number): print('made')\n"
        "    def step(self, t, y, neighbours, s):\n        print('asked')\n"
        "        os.write(1, b'told')\n        return 0.0\n"
    )
    text = (resources.shipped("models") / "paper_example_1_tanh.toml").read_text()
    (tmp_path / "one.toml").write_text(f'{text}\n[control]\npython = "mine.py:Mine"\n')
    command = [sys.executable, "-m", "posmas_fmi", "run", "one.toml", "--until", "0.01", "--json"]
    made = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert json.loads(made.stdout)["certified"] == "no"
    assert made.returncode == 1
    assert all(word in made.stderr for word in ("made", "asked", "told"))
