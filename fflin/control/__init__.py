"""From a linear model to a law: weights, gains, filters, policies."""
