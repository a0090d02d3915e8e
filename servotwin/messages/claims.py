"""Claims of edges to be the only one of their servo, and the twin's answer.

The numbers are a fencing token: the twin gives each taker-over the next one, a request names the one that its sender
holds, and the twin refuses the requests of all that were superseded. No clock takes part.
"""

from typing import Annotated

from msgspec import Meta, Struct

from servotwin.messages.checks import Count, Name, Text

PROTOCOL = 5
"""Version of the protocol between edge and twin: 1 had no claims and did not tell its number; 2 had no reason of its
own for an update that meets a fallback; 3 none for one at an edge that was superseded; the answers of 4 over HTTP did
not tell which body had come."""

CLONED = "cloned"
"""In place of a run: two copies of one run send, of which the twin can tell none from the other, and neither counts."""


class EdgeClaim(Struct, frozen=True, omit_defaults=True, tag="claim/1"):
    """Question of an edge that runs, which claim of its servo counts; or its claim.

    Attributes
    ----------
    run : str
        Name of this run of the edge: its first boot.
    held : int
        Number of the claim that it has; 0: none yet. One that is not the newest any more is a conflict: two edges run.
    takes : int
        Number that it claims, one above the newest that it knows (compare-and-swap, so that a repeated claim changes
        nothing); 0: it only asks.
    protocol, software : int, str
        Version of the edge's protocol, and of servotwin there.
    behind : bool
        The edge's folder knows nothing of the run whose claim it takes over from: it is an older one, or a copy.
    """

    servo: Name
    run: Name
    held: Count = 0
    takes: Count = 0
    protocol: Count = 1
    software: Text = ""
    behind: bool = False


class ClaimStatus(Struct, frozen=True, omit_defaults=True, tag="standing/1"):
    """The newest claim of a servo that the twin knows.

    Attributes
    ----------
    run : str
        Run of the edge whose it is; empty: there is none yet.
    number : int
        Its number; 0: there is none yet.
    protocol, software : int, str
        Version of the twin's protocol, and of servotwin there.
    samples_per_window, bytes_per_day : int
        Most samples of a window, and bytes of the servo's messages in a day, that the twin takes; 0: it does not say.
    """

    servo: Name
    run: Annotated[str, Meta(max_length=64)] = ""
    number: Count = 0
    protocol: Count = 1
    software: Text = ""
    samples_per_window: Count = 0
    bytes_per_day: Count = 0
