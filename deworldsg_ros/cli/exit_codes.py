"""Exit codes of the `deworldsg` program, besides 0."""

# Bad usage, a bad configuration, or a recording that cannot be used.
EXIT_USAGE = 2
# Ctrl-C: 128 + SIGINT, as shells report it.
EXIT_INTERRUPTED = 130
# An evaluation in which every scan failed.
EXIT_NOTHING_DONE = 1
# `deworldsg doctor` found something that has to be mended.
EXIT_FINDINGS = 3
