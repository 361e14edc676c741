"""What a linear model tells: reach, modes, momenta, how far it can be trusted."""
