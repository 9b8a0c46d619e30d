"""Control design with FMUs for process cooling: proved pinning consensus of positive networks."""
