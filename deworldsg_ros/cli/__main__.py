"""`python -m deworldsg_ros.cli` is `deworldsg`."""

from deworldsg_ros.cli.app import main

main()
