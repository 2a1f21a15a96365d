"""`python -m deworldsg_ros.cli` is `deworldsg`."""

from deworldsg_ros.cli import main

if __name__ == "__main__":  # the processes of `deworldsg compile` import it, too
    main()
