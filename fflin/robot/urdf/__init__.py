"""A URDF text becomes a checked Pinocchio model.

XML, xacro, links, joints, the tree, mimic joints, inertias. Imports `base` alone.
"""
