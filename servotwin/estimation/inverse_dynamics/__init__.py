"""Parameters of a drive from its command and position: filtered inverse dynamics and least squares."""
