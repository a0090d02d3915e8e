"""Decide at the edge which windows are worth sending."""
