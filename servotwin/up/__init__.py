"""`servotwin up`: twin, edges and simulated machines as real processes on this machine, started, watched and ended."""
