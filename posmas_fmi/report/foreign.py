"""Text and numbers from files: what is unprintable or not a number becomes harmless."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

AGAIN = "run the scenario again with 'posmas-fmi run'"


def clean(text: str) -> str:
    """Replace characters that cannot be printed (controls, surrogates, direction overrides)."""
    return "".join(c if c.isprintable() or c in "\n\t" else "�" for c in text)


def number(value: Any) -> float | None:
    """Return a finite or infinite number as float, None for anything else and for NaN."""
    if isinstance(value, str | bytes | bool) or value is None:
        return None
    try:
        result = float(np.asarray(value).item())
    except (TypeError, ValueError, OverflowError):
        return None
    return None if math.isnan(result) else result


def one_line(error: Exception) -> str:
    """Return the first line of an error's text, for a message of our own."""
    lines = clean(str(error)).splitlines()
    return lines[0][:200] if lines else type(error).__name__
