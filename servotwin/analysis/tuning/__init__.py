"""Tune a controller to a crossover and a phase margin."""
