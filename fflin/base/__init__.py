"""Basic modules that do not depend on a robot.

The modules contain errors, files and records, rotations, tables and figures, and checks of
arguments. They import no other package of fflin.
"""

__version__ = "0.2.0"
