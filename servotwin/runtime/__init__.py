"""Plumbing without servos: clocks, files, locks, pipes and child processes; standard library and msgspec only."""
