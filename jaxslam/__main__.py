"""`python -m jaxslam`: the command line interface."""

import sys

from jaxslam.cli.main import main

sys.exit(main())
