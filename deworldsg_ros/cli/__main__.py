"""`python -m deworldsg_ros.cli` is `deworldsg`."""

from deworldsg_ros.cli import main

main()
