"""Joint estimation of gap and model parameters, and the identifiability of the motor's parameters."""
