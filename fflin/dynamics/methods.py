"""Names of the integration methods.

`integrators` has the class of each name. This module imports nothing, so that the command line can
list the names at once.
"""

CF4 = "cf4"
SEMI_IMPLICIT_EULER = "semi_implicit_euler"
METHODS = (CF4, SEMI_IMPLICIT_EULER)

# Method of simulations, trajectories and plans, unless the user gives another one.
DEFAULT_METHOD = CF4
