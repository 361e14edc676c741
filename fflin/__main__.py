"""Run the command line as ``python -m fflin``."""

import sys

from fflin.cli import main

sys.exit(main())
