"""The edge as a process: control beside the drive, the link in a process of its own; stdlib and msgspec only."""
