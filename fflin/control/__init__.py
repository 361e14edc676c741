"""Control design for linear models: weights, gains, filters and policies."""
