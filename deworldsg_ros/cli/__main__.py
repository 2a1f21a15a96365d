"""`python -m deworldsg_ros.cli` is `deworldsg`."""

import sys

from deworldsg_ros.cli.main import main

sys.exit(main())
