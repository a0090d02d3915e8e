"""The twin: it estimates the gap from windows, redesigns the setting and sends updates; plain classes without I/O."""
