"""Readers of what strangers wrote, each with bytes to begin from; used by two fuzzers."""
