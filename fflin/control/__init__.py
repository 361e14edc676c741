"""From a linear model to a law: weights, gains, filters, policies.

Imports `base`, `robot`, `dynamics`, `linear` and `analysis`.
"""
