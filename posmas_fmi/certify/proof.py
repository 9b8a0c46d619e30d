"""Proofs that hold in floating point or in exact rational arithmetic."""

from __future__ import annotations

UNIT = 2.0**-53  # rounding unit of IEEE 754 double precision
