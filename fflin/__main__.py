"""Entry point of ``python -m fflin``."""

from fflin.cli import main

raise SystemExit(main())
