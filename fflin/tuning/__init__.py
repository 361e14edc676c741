"""Controllers of a given structure, tuned to requirements over uncertain models."""
