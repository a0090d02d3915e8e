"""The gap from positions alone: load = ratio x play(motor) + offset, with what else the recording shows."""
