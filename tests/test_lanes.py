"""Several agents at once in C: how accurate, and the same bits however they are grouped."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path

import mpmath
import numpy as np
import pytest
from fmu_examples import example_1, wide

from posmas_fmi.agent import Agent
from posmas_fmi.cosim import native
from posmas_fmi.cosim.propagator import Propagator
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu.compile import host, shared_library
from posmas_fmi.fmu.positive_agent import functions_header

CSRC = Path(native.__file__).parent / "csrc"
FUNCTIONS = ("sin", "cos", "exp", "tanh", "sqrt", "abs", "sign")

EACH = """
#include "lanes.h"
#include "export.h"
#define EACH(name, call)                                                \\
    EXPORT void run_##name(const double *x, double *y, int64_t n)       \\
    {                                                                   \\
        LanesRange range = {.mends = 1};                                \\
        (void)range;                                                    \\
        for (int64_t i = 0; i < n; i += LANES) {                        \\
            LanesView view;                                             \\
            for (int l = 0; l < LANES; l++)                             \\
                view.lane[l] = x[i + l];                                \\
            view.value = call;                                          \\
            for (int l = 0; l < LANES; l++)                             \\
                y[i + l] = view.lane[l];                                \\
        }                                                               \\
    }
"""


def compiled(files: dict[str, str], units: list[str], folder: Path, flags: tuple[str, ...]):
    sources = native._read(("lanes.h",)) | files
    path = folder / f"lanes{host().extension}"
    path.write_bytes(shared_library(sources, units, "lanes", host(), ("-O3", *flags)))
    return ctypes.CDLL(str(path))


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


@pytest.fixture(scope="module", params=[1, 2, 4, 8])
def lanes(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Callable:
    """A function by its name, computed in so many lanes; values in multiples of 8."""
    more = dict.fromkeys(("sin", "cos", "exp"), ", &range")
    calls = (f"EACH({name}, lanes_{name}(view.value{more.get(name, '')}))\n" for name in FUNCTIONS)
    code = EACH + "".join(calls)
    folder = tmp_path_factory.mktemp("lanes")
    library = compiled({"each.c": code}, ["each.c"], folder, (f"-DLANES={request.param}",))

    def call(name: str, x: np.ndarray) -> np.ndarray:
        y = np.empty_like(x)
        getattr(library, f"run_{name}")(pointer(x), pointer(y), ctypes.c_int64(len(x)))
        return y

    return call


def points(low: float, high: float, count: int = 400) -> np.ndarray:
    return np.random.default_rng(1).uniform(low, high, count)


NEAR_MULTIPLES = np.arange(1, 63_001, 175) * (np.pi / 2)  # of pi/2, up to 1e5: most is cancelled


@pytest.mark.parametrize(
    ("name", "x", "ulps"),
    [
        ("sin", points(-1, 1), 3),
        ("sin", points(-1e5, 1e5), 3),
        ("sin", NEAR_MULTIPLES, 3),
        ("cos", points(-1, 1), 3),
        ("cos", points(-1e5, 1e5), 3),
        ("cos", NEAR_MULTIPLES, 3),
        ("sin", points(-1e9, 1e9), 1),  # these go to math.h
        ("exp", points(-1, 1), 2),
        ("exp", points(-690, 690), 2),
        ("tanh", points(-1, 1), 4),
        ("tanh", points(-25, 25), 4),
        ("tanh", 10.0 ** points(-300, 0), 4),
    ],
)
def test_accuracy(lanes: Callable, name: str, x: np.ndarray, ulps: float) -> None:
    x = x[: len(x) // 8 * 8]
    with mpmath.workprec(200):
        for value, computed in zip(x, lanes(name, x), strict=True):
            exact = getattr(mpmath, name)(mpmath.mpf(float(value)))
            error = abs(mpmath.mpf(float(computed)) - exact)
            assert error <= ulps * float(np.spacing(abs(float(exact)))), value


@pytest.mark.parametrize("name", FUNCTIONS)
def test_special_values(lanes: Callable, name: str) -> None:
    # one of them in a vector must not change what its neighbours are
    for special in (0.0, np.inf, -np.inf, np.nan, 5e-324, 1e300, -1e300, 710.0, -750.0, -1.0):
        x = np.array([0.5, special, 1.0, 0.25, special, 2.0, 0.125, 3.0])
        with np.errstate(all="ignore"):
            expected = getattr(np, name)(x)
        np.testing.assert_allclose(lanes(name, x), expected, rtol=1e-15)


ALL = [
    "x1*sin(0.31*x1*t) + 2",
    "min(x2, 0.5, x1) - max(x1, -t)*abs(cos(x2)) + sign(x1 - 1)",
    "exp(-x1)*tanh(x2) + sqrt(x1 + 3)/(1 + x2**2) + clip(x1, 0.1, 0.9)",
    "tan(x1) + atan(x2) + log(x1 + 5) + sinh(x2) + cosh(x1) + 1.3**x1 + (x2 + 4)**1.7",
    "sin(t) + sqrt(2)*x1**3 + x2**-2 + (x1 + 4)**-0.5 + pi",
    "0.3",
    "exp(1) + min(sqrt(2), 3)",
]

EXPRESSIONS = """
#include <string.h>
#include "agent_functions.h"
#include "export.h"
EXPORT void run(double t, const double *x, double *g)
{
    Lanes from[M], to[M];
    LanesRange range = {.mends = 1};
    memcpy(from, x, sizeof from);
    agent_g(lanes_of(t), from, to, &range);
    memcpy(g, to, sizeof to);
}
"""


@pytest.mark.parametrize("count", [1, 4])
def test_expressions(count: int, tmp_path: Path) -> None:
    names = ["t", *(f"x{k + 1}" for k in range(len(ALL)))]
    g = VectorFunction.parse(ALL, names)
    sec = VectorFunction.parse(["u1"], ["u1"])
    header = functions_header(g, sec, len(ALL), 1, 1, lanes=True)
    files = {"agent_functions.h": header, "run.c": EXPRESSIONS}
    library = compiled(files, ["run.c"], tmp_path, (f"-DLANES={count}",))
    x, result = np.random.default_rng(2).uniform(0.1, 1.5, (2, len(ALL), count))
    library.run(ctypes.c_double(0.7), pointer(x), pointer(result))
    np.testing.assert_allclose(result.T, g.numpy()(0.7, *x), rtol=2e-15)


BLOCKS = """
#include "controller.h"
#include "export.h"
typedef void Block(const Controller *, int, double, const double *, const double *, const double *,
                   double *, double *, double *);
Block controller_block_2, controller_block_4, controller_block_8;
EXPORT int run(int lanes, const Controller *c, int n, double t, const double *driven,
               const double *all, const double *memory, double *next, double *u, double *applied)
{
    Block *block = lanes == 2 ? controller_block_2 : controller_block;
#if defined __x86_64__
    if (lanes == 4 && __builtin_cpu_supports("avx2"))
        block = controller_block_4;
    if (lanes == 8 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl"))
        block = controller_block_8;
#endif
    block(c, n, t, driven, all, memory, next, u, applied);
    return CONTROLLER_BLOCK;
}
EXPORT void one(const Controller *c, double t, const double *all, const double *memory,
                double *next, double *u, double *applied)
{
    controller_step(c, 0, t, 0, all, 0, memory, next, u, applied);
}
EXPORT void leader(const Controller *c, double t, const double *memory, double *next)
{
    controller_leader(c, t, memory, next);
}
"""


@pytest.mark.parametrize("example", [example_1(), wide()], ids=["example 1", "other sizes"])
def test_blocks_give_the_bits_of_single_agents(example, tmp_path: Path) -> None:
    (m, p, q), B = example.sizes, 16
    header = functions_header(example.g, example.sec, m, p, q, lanes=True)
    files = dict(native.engine_sources("protocol", header).files) | {"blocks.c": BLOCKS}
    units = [
        name for name in files if name.startswith(("block", "controller.")) and name[-1] == "c"
    ]
    library = compiled(files, units, tmp_path, ())
    agent = Agent(A=example.A, H=example.H, B=example.B, C=example.C, g=example.g, sec=example.sec)
    step = Propagator.of(agent, 0.01)
    random = np.random.default_rng(3)
    matrices = (random.normal(size=(p, m)), random.normal(size=(m, q)), agent.B, agent.C)
    constants = np.concatenate([[0.01], *(a.ravel() for a in (*matrices, *step.in_c.values()))])
    disagreement, memory = random.normal(size=(m + q, B)), random.uniform(0, 2, (m, B))
    memory[:, 5] *= 1e8  # beyond the reduction of sin
    driven, t = np.array([1.0] * 15 + [0.0]), ctypes.c_double(0.7)
    expected = [np.empty((rows, B)) for rows in (m, p, p)]
    for k in range(B):
        columns = [np.ascontiguousarray(a[:, k]) for a in (disagreement, memory, *expected)]
        library.one(pointer(constants), t, *(pointer(c) for c in columns))
        if not driven[k]:
            library.leader(pointer(constants), t, pointer(columns[1]), pointer(columns[2]))
        for array, column in zip(expected, columns[2:], strict=True):
            array[:, k] = column
    for lanes in (2, 4, 8):
        for n in range(1, B + 1):  # of the columns count
            actual = [np.empty((rows, B)) for rows in (m, p, p)]
            arrays = (pointer(a) for a in (driven, disagreement, memory, *actual))
            assert library.run(lanes, pointer(constants), n, t, *arrays) == B
            for array, wanted in zip(actual, expected, strict=True):
                np.testing.assert_array_equal(array[:, :n], wanted[:, :n])
