"""A stretch of recorded samples that was cut to be sent: raw, before anything is judged or packed."""

from array import array
from typing import NamedTuple

TIMED = "timed"
"""Reason of a window that was cut because the filter's longest pause was over."""


class Cut(NamedTuple):
    """Samples first .. last - 1 of one boot, and why they were cut.

    Attributes
    ----------
    first : int
        Index of the first sample since the start of the edge.
    sequence : int
        Which window of this boot it becomes.
    reason : str
        Why it was cut.
    parameter_version : int
        In force when it was cut.
    before : float
        Reference just before the first sample, m.
    signals : dict of str to array of double
        Channel by channel, equally long: m, rad, m, V.
    gap : float or None
        rad: what the update in force gives as the gap; None: none is in force, or it gives none.
    basis : int or None
        Sequence of the window of this boot that it stands on.
    """

    first: int
    sequence: int
    reason: str
    parameter_version: int
    before: float
    signals: dict[str, "array[float]"]
    gap: float | None = None
    basis: int | None = None

    @property
    def samples(self) -> int:
        """Samples per channel."""
        return len(self.signals["reference"])

    @property
    def last(self) -> int:
        """Index of the first sample after it."""
        return self.first + self.samples
