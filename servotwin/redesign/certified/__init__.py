"""Settings verified by simulation on the machines that the evidence allows."""
