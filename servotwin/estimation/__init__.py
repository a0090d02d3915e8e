"""From measurements to the gap: windows, observers, estimators, and what an estimate says of itself."""
