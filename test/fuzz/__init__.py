"""One fuzz harness for all that reads data from outside; docs/dev/reliability.md has its figures.

`targets` says what is read, `mutations` damages good files, `worker` runs cases in limits of memory
and time, `harness` keeps those that failed, `corpus/` has all of them.
"""
