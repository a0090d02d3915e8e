"""Drives behind one protocol: simulated (a process of its own), replay, OPC UA."""
