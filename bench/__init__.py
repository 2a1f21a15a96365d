"""Benchmarks of the package; `python -m bench --json FILE` runs all that need one machine."""
