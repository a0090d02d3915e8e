"""The machine's side: record, send windows, guard the parameters."""
