"""Solvers of optimal control problems: Riccati equations, and programs over a motion's stages."""
