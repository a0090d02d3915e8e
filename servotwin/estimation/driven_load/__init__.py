"""A load behind play and spring, driven by the motor's measured angle: its dynamics from the log of two encoders."""
