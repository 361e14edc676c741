"""Reader that turns the text of a URDF into a checked Pinocchio model.

XML, xacro, links, joints, the tree, mimic joints, inertias. Imports `base` alone.
"""
