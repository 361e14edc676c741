"""Reader that turns the text of a URDF into a checked Pinocchio model.

It handles XML, xacro, links, joints, the tree, mimic joints and inertias. Imports only `base`.
"""
