"""Plumbing without servos: retries, frames, child processes, locks and atomic files; standard library and msgspec only."""
