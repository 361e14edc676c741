"""The command line, a module for each group: parse, call one function, print or save.

Imports every room; no room imports it.
"""

DONE, FELL_SHORT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
