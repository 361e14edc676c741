"""The commands, a module for each group: parse, call one public function, print or save."""

DONE, FELL_SHORT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
