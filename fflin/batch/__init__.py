"""Many points at once: points, workers, files, gains between points.

Imports `base`, `robot`, `dynamics`, `kernel`, `linear` and `control`.
"""
