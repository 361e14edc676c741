"""What a robot's parameters change in its models, and models whose parameters are uncertain."""
