"""Analysis of linear models: controllability, observability, modes and momenta."""
