"""The command line, a module for each group: parse, call one function, print or save."""

DONE, FELL_SHORT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
