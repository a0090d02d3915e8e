"""Hook of an optional window filter, which chooses the cut windows that are sent.

The agent's settings carry a `WindowFilterSettings`. The edge's core names no implementation.
"""

from typing import Protocol

from servotwin.edge.recorder import Cut
from servotwin.messages import LearntResponse


class WindowFilter(Protocol):
    """A filter at work on the windows of one boot."""

    @property
    def response_version(self) -> int:
        """Version of the learnt response in use; 0: the configured one."""

    def adopt(self, response: LearntResponse) -> None:
        """Use a learnt response from the next window on; one that is not newer, or for another rate, is ignored."""

    def __call__(self, cut: Cut) -> Cut | None:
        """Return the window to send, perhaps with another reason; None: do not send it."""

    def dumps(self) -> bytes:
        """Encode the state, which `WindowFilterSettings.start` takes in the next boot."""


class WindowFilterSettings(Protocol):
    """Settings of a filter, which start it."""

    @property
    def longest_pause_s(self) -> float:
        """Time after a window at which one is cut though the reference rests, s; inf: never."""

    def check(self, sample_rate: float) -> None:
        """Raise InvalidInput where the filter cannot run, or is not made for samples at this rate (Hz)."""

    def start(self, saved: bytes | None = None) -> WindowFilter:
        """Start the filter for a new boot, from the state that an earlier boot saved.

        Raises
        ------
        InvalidInput
            The bytes are not a state of this filter.
        """
