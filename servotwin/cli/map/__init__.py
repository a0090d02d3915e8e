"""The command `servotwin map`: its arguments, its table and its picture."""
