"""Plumbing without servos: retries, frames, processes, locks and atomic files; standard library and msgspec only."""
