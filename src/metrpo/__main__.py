"""`python -m metrpo`: the command line."""

import sys

from metrpo.commands.main import main

sys.exit(main())
