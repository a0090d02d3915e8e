"""The gap together with the model's own numbers, and what of the motor can be known at all."""
