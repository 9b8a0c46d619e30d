"""Preflight of an FMU: what can be told without running it, and what a trial run shows."""
