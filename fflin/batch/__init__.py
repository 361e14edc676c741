"""Sweeps: linear models and gains about many points, computed on threads or worker processes.

`run` applies a job to rows, chunk by chunk, on threads or worker processes. Results go into a store
of `files`, from which a run resumes after a crash. In a `sweep`, the rows are `configurations`. The
result is a `linear_batch`; `gains` designs regulators for its points.

Imports `base`, `robot`, `dynamics`, `kernel`, `linear` and `control`.
"""
