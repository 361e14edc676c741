"""Foundations that depend on no robot.

Errors, files and records, rotations, tables and figures, checks of arguments. Imports no other
room.
"""

__version__ = "0.2.0"
