"""Reads shared samples as a link process does for a live view that somebody watches: `... live_reader FD RATE`."""

from __future__ import annotations

import os
import sys
from threading import Event

from servotwin.edge_process.live_view import LiveView
from servotwin.edge_process.shared_samples import SampleReader
from servotwin.link.claim import HeldClaim
from servotwin.messages.live import LiveColumns, encode_live


class AlwaysWatched:
    """A twin at which somebody always watches."""

    def send(self, columns: LiveColumns, claim: HeldClaim) -> bool:  # noqa: ARG002
        """Encode the columns, as for the wire."""
        encode_live(columns)
        return True

    def close(self) -> None:
        """Close nothing."""


if __name__ == "__main__":
    os.nice(10)
    reader = SampleReader(int(sys.argv[1]))
    LiveView(AlwaysWatched(), reader, "axis-1", float(sys.argv[2]), lambda: HeldClaim("bench", 1), Event()).run()
