"""The controllers of a network as C, with the data of its agents and an example that runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from posmas_fmi.export.controller import CSRC, Controllers, braced
from posmas_fmi.expression import Array

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
        If g or sec are Python functions.
    """
    return controllers.files() | {
        "agents.h": _agents(controllers, names),
        "network.c": (CSRC / "network.c").read_text(encoding="utf-8"),
        "CMakeLists.txt": _BUILD,
    }


def _agents(controllers: Controllers, names: Sequence[str]) -> str:
    links = controllers.links
    senders = [[*one.senders, *[-1] * (controllers.heard - len(one.senders))] for one in links]
    tables = [
        _table(
            "const AgentLinks LINKS[AGENTS]",
            [_links(controllers.parameters(i)) for i in range(len(links))],
            names,
        ),
        _table(
            "const int SENDER[AGENTS][HEARD]",
            [f"{{{', '.join(map(str, row))}}}" for row in senders],
            names,
        ),
        _table("const double START[AGENTS][M]", [braced(x) for x in controllers.xhat0], names),
        f"static const double S0[M] = {braced(controllers.s0)};",
    ]
    return "\n\n".join(
        [
            "/* The agents: their weights, whom they hear (from 0; -1: nobody) and their first\n"
            " * estimates; and the first state of the leader. Generated. */\n"
            "#ifndef AGENTS_H\n#define AGENTS_H\n\n"
            '#include "agent.h"\n\n'
            f"enum {{ AGENTS = {len(links)} }};",
            *tables,
            "#endif\n",
        ]
    )


def _links(parameters: Mapping[str, Array]) -> str:
    members = (f".{name} = {braced(value)}" for name, value in parameters.items())
    return f"{{{', '.join(members)}}}"


def _table(head: str, rows: Sequence[str], names: Sequence[str]) -> str:
    lines = [
        f"    {row}, /* {name.replace('*/', '* /').replace('/*', '/ *')} */"
        for row, name in zip(rows, names, strict=True)
    ]
    return "\n".join([f"static {head} = {{", *lines, "};"])
