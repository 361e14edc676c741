"""What every room stands on and that knows no robot.

Errors, files and records, rotations, tables and figures, checks of arguments. Imports no other
room.
"""
