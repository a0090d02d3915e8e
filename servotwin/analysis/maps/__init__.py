"""Stability maps: which dead zones settle, over gap, tolerance and amplitude."""
