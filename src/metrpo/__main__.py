"""`python -m metrpo`: the command line."""

import sys

from metrpo.cli import main

sys.exit(main())
