"""`python -m jaxslam`: the command line."""

import sys

from jaxslam.cli import main

sys.exit(main())
