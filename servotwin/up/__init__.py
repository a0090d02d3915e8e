"""`servotwin up`: runs twin, edges and simulated machines as real processes on this machine."""
