"""The twin as a service: HTTP in front of the store, workers behind it."""
