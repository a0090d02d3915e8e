"""The command line: commands and their text."""
