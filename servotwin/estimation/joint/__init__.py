"""Joint estimation of gap and model parameters."""
