"""The twin as a service: HTTP in, commit, acknowledge, estimate in a pool, updates out."""
