"""FMUs in worker processes: what they do to their process stays there."""
