"""`servotwin bench fleet`: ten thousand servos, one twin, real processes."""
