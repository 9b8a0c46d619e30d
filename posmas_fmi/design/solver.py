"""Semidefinite programs through cvxpy and clarabel; a status is a hint here, never a proof."""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import Any

from posmas_fmi.errors import DesignError

_USABLE = ("optimal", "optimal_inaccurate")
_UNFINISHED = ("user_limit", "user_limit_inaccurate")
TIME_LIMIT = 120.0  # s for one program


def cvxpy() -> Any:
    """Import cvxpy where it is needed: it costs more than a second."""
    return import_module("cvxpy")


def solve(problem: Any, what: str) -> bool:
    """Solve a cvxpy problem in place.

    Parameters
    ----------
    problem : cvxpy.Problem
    what : str
        Name of the program, for the error.

    Returns
    -------
    bool
        Whether there is a point to round and prove; False for infeasible or unbounded programs.

    Raises
    ------
    DesignError
        If the solver breaks down or does not finish in `TIME_LIMIT`.
    """
    cp = cvxpy()
    try:
        with warnings.catch_warnings():
            # whether a point is good enough is for the proof to say
            warnings.filterwarnings("ignore", "Solution may be inaccurate", UserWarning)
            problem.solve(solver=cp.CLARABEL, time_limit=TIME_LIMIT)
    except cp.error.SolverError as error:
        raise DesignError(f"{what}: the solver failed ({error})", "$.design.method") from error
    except BaseException as error:
        # clarabel is written in Rust: a panic there is no Exception
        if type(error).__name__ == "PanicException":
            raise DesignError(
                f"{what}: the solver panicked ({error}); a problem near the boundary of "
                "feasibility does that, move a bound a little",
                "$.design.method",
            ) from None
        raise
    if problem.status in _UNFINISHED:
        raise DesignError(
            f"{what}: the solver was not done after {TIME_LIMIT:g} s; the contraction design "
            "needs no such program",
            "$.design.method",
        )
    return problem.status in _USABLE


def feasible(program: Any, slack: Any) -> bool:
    """Whether the solver finds a strictly feasible point; its failures count as no."""
    try:
        return solve(program, "bisection") and slack.value is not None and slack.value > 1e-7
    except DesignError:
        return False
