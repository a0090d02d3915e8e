"""The remote side: windows come in, estimates are made, new parameters go out. Plain classes, no clock, no I/O."""
