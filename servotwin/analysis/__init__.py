"""Limit cycles, stability maps and controller tuning."""
