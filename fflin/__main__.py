"""Run the command line as ``python -m fflin``."""

import sys

from fflin.commands.cli import main

sys.exit(main())
