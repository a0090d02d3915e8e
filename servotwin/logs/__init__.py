"""Recorded logs: one registry of readers and writers."""
