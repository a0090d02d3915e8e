"""The policies side by side, on random machines."""
