"""Many points at once: points, workers, files, gains between points.

A sweep's `configurations` and `task` are cut into `chunks`, which `dispatch` gives to threads or
workers; the `store` keeps what they come to, and a `linear_batch` is read from it.

Imports `base`, `robot`, `dynamics`, `kernel`, `linear` and `control`.
"""
