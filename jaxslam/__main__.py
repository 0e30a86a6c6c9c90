"""`python -m jaxslam`: the command line interface."""

import sys

from jaxslam.cli import main

sys.exit(main())
