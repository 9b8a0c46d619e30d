"""Proofs about given gains: the certificates P, C, S, T, R, G, D of theory.md."""

from __future__ import annotations

from posmas_fmi.certify.certificate import Certificate, Condition, Region
from posmas_fmi.certify.closed_loop import baseline, certify_loop
from posmas_fmi.certify.loop import Loop

__all__ = ["Certificate", "Condition", "Loop", "Region", "baseline", "certify_loop"]
