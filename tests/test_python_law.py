"""Controllers written in Python: the documented interface, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from posmas_fmi.agent import linear_agent
from posmas_fmi.cosim import engine
from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import System, simulate
from posmas_fmi.cosim.plant import ModelPlant
from posmas_fmi.cosim.python_law import PythonLaw, load_class
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


@pytest.mark.parametrize("answer", [[1.0, 2.0], "x", None, np.nan])
def test_answers_that_are_no_input_name_the_agent(answer: Any) -> None:
    class Wrong:
        def step(self, *_: Any) -> Any:
            return answer

    with pytest.raises(InputError, match="step of agent 1"):
        rows_of(PythonLaw(AGENT, NETWORK, [Wrong()] * 3))


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
