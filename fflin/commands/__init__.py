"""Command line: parse arguments, call one library function, print or save its result.

This package imports every other package of fflin; no other package imports it.
"""

DONE, FELL_SHORT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

# Value of --orbit and --field that removes the orbit or the field of a robot file.
NO_ORBIT = "none"
