"""The gap from positions alone: load = ratio x play(motor) + offset, with lag, wind-up and cyclic error where the log shows them."""
