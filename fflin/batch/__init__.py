"""Sweeps: linear models and gains at many points, on threads or worker processes.

`run` applies a job to rows, chunk by chunk, on threads or worker processes. It saves the results in
a store of `files`; after a crash, the same call resumes from this store. In a `sweep`, the rows are
`configurations`, and the result is a `linear_batch`. `gains` designs regulators for its points.

Imports `base`, `robot`, `dynamics`, `kernel`, `linear` and `control`.
"""
