"""Basic modules that do not depend on a robot.

They define errors, checks of arguments, names of states and inputs, rotations, atomic writing,
records on disk, text tables and figures. They import no other package of fflin.
"""

__version__ = "0.2.0"
