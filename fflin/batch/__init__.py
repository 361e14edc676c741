"""Many points at once: points, workers, files, gains between points.

Imports `base`, `robot`, `dynamics`, `linear` and `control`; `batch.kernel` is the compiled part.
"""
