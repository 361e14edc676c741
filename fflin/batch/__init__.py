"""Many points at once: points, workers, files, gains between points.

`run` takes any rows through any job: chunk by chunk, on threads or by `dispatch` on workers, into a
`store` that goes on after a crash. A sweep is such a run: of `configurations` (and what is the same
about them, a `task`) through the job of `chunks`; a `linear_batch` is read from the store.

Imports `base`, `robot`, `dynamics`, `kernel`, `linear` and `control`.
"""
