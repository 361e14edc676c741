"""What fflin costs beside its peers: ``python -m benchmarks`` runs all and writes the tables."""
