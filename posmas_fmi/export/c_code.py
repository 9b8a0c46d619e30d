"""The controllers of a network as C, with the data of its agents and an example that runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from posmas_fmi.export.controllers import Controllers, braced
from posmas_fmi.expression import Array

_CSRC = Path(__file__).parent / "csrc"
_BUILD = """\
cmake_minimum_required(VERSION 3.10)
project(network C)
set(CMAKE_C_STANDARD 99)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()
add_executable(network network.c agent.c controller.c)
# without it a compiler may join a product and a sum, and the last bits differ from those simulated
target_compile_options(network PRIVATE -ffp-contract=off)
target_link_libraries(network m)
"""


def c_files(controllers: Controllers, names: Sequence[str]) -> dict[str, str]:
    """Return the files of the C export by name.

    Parameters
    ----------
    controllers : Controllers
    names : sequence of str
        Of the agents, for comments.

    Returns
    -------
    dict
        ``agent.h`` and what it needs, ``agents.h`` with the data of all agents, ``network.c``, an
        example of their use, and ``CMakeLists.txt``.

    Raises
    ------
    InputError
        If the law cannot be had in C.
    """
    own = {name: (_CSRC / name).read_text(encoding="utf-8") for name in _OWN}
    return (
        controllers.files()
        | own
        | {
            "agents.h": _agents(controllers, names),
            "CMakeLists.txt": _BUILD,
        }
    )


_OWN = ("agent.h", "agent.c", "network.c")


def _agents(controllers: Controllers, names: Sequence[str]) -> str:
    law, links = controllers.law, controllers.links
    senders = [[*one.senders, *[-1] * (controllers.heard - len(one.senders))] for one in links]
    own_values = law.own_values
    values = "static const double *const OWN_VALUES[AGENTS] = {0}; /* all are alike */"
    if own_values.size:
        rows = [braced(row) for row in own_values]
        values = _table("const double OWN_VALUES[AGENTS][OWN]", rows, names)
    start = [braced(row) for row in law.start(controllers.xhat0)]
    return "\n\n".join(
        [
            "/* The agents: their weights and own values, whom they hear (from 0; -1: nobody),\n"
            " * and what they and the leader remember at the start. Generated. */\n"
            "#ifndef AGENTS_H\n#define AGENTS_H\n\n"
            '#include "agent.h"\n\n'
            f"enum {{ AGENTS = {len(links)} }};",
            _table(
                "const AgentLinks LINKS[AGENTS]",
                [_links(controllers.weights(i)) for i in range(len(links))],
                names,
            ),
            values,
            _table(
                "const int SENDER[AGENTS][HEARD]",
                [f"{{{', '.join(map(str, row))}}}" for row in senders],
                names,
            ),
            _table("const double START[AGENTS][MEMORY]", start, names),
            f"static const double LEADER[MEMORY] = {braced(law.lead(controllers.s0))};",
            "#endif\n",
        ]
    )


def _links(weights: Mapping[str, Array]) -> str:
    members = (f".{name} = {braced(value)}" for name, value in weights.items())
    return f"{{{', '.join(members)}}}"


def _table(head: str, rows: Sequence[str], names: Sequence[str]) -> str:
    plain = [name.replace("*/", "* /").replace("/*", "/ *") for name in names]
    lines = [f"    {row}, /* {name} */" for row, name in zip(rows, plain, strict=True)]
    return "\n".join([f"static {head} = {{", *lines, "};"])
