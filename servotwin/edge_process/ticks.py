"""How long things take, counted by microseconds: cheap to add to, exact to a microsecond, of fixed size."""

from array import array

_KIND = "Q"  # 64 bits on every machine: at 5 kHz 32 bits are full in ten days
BINS = 4096
"""Longer times count as the last one; the longest is kept as it is."""


class Counts:
    """Durations, s."""

    def __init__(self) -> None:
        self.bins = array(_KIND, bytes(array(_KIND).itemsize * BINS))
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        """Count one."""
        self.bins[min(max(int(seconds * 1e6), 0), BINS - 1)] += 1
        if seconds > self.longest:
            self.longest = seconds

    def dumps(self) -> bytes:
        """The counts as bytes."""
        return self.bins.tobytes()


def summary(data: bytes, longest: float) -> dict[str, float]:
    """Number, and median, p99, p99.9 and maximum in microseconds, of `Counts.dumps`.

    What is longer than the bins reach is told as the longest.
    """
    bins = array(_KIND)
    bins.frombytes(data)
    total = sum(bins)
    shares = {"median_us": 0.5, "p99_us": 0.99, "p999_us": 0.999}
    found = {name: float(quantile(bins, total, share)) for name, share in shares.items()}
    found = {name: value if value < BINS else round(longest * 1e6, 1) for name, value in found.items()}
    return {"number": total, **found, "max_us": round(longest * 1e6, 1)}


def quantile(bins: "array[int]", total: int, share: float) -> int:
    """The microsecond below which a share of the durations lies (the end of its bin)."""
    need, seen = share * total, 0
    for microsecond, count in enumerate(bins):
        seen += count
        if seen >= need and seen > 0:
            return microsecond + 1
    return 0
