"""Sweeps: linear models and gains about many points, on threads or worker processes.

`run` processes rows by a job, chunk by chunk, on threads or on workers. Results go into a `store`,
from which a run resumes after a crash. In a sweep the rows are `configurations`, and the job is in
`chunks`. The result is a `linear_batch`, for whose points `gains` designs regulators.

Imports `base`, `robot`, `dynamics`, `kernel`, `linear` and `control`.
"""
