"""Command line with one module per group of commands: parse, call one function, print or save.

This package imports every other package of fflin; no other package imports it.
"""

DONE, FELL_SHORT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
