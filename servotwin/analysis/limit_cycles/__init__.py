"""Exact limit cycles of the loop with backlash, and the describing function's prediction of them."""
