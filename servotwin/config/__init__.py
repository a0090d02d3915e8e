"""Declared settings: one reader and one writer."""
