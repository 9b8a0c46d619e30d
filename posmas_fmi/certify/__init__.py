"""Proofs about given gains: the certificates P, C, S, T, R, G, D of theory.md."""

from __future__ import annotations

from posmas_fmi.certify.certificate import Certificate, Condition, Region

__all__ = ["Certificate", "Condition", "Region"]
