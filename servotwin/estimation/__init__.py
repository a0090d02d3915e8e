"""Estimation of the gap from measurements: windows, observers, estimators, estimates with their spread and status."""
