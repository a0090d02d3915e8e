"""Novelty: a window filter that sends only windows which tell the twin something new.

`settings` needs no numbers library; whoever starts the filter loads `detector`, which does.
"""
