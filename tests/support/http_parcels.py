"""Messages of an edge as its HTTP transport sends them."""

from servotwin.link.transport import Parcel
from servotwin.messages import Hello, Setting, WindowMessage, checksum, encode, pack_channel
from servotwin.messages.codec import deflated

CHANNEL = pack_channel("position", "m", [(k // 50) * 1e-6 for k in range(500)])
HELLO = Hello("axis-1", "b0", 0.0, 10.0, 0, Setting(0.0), "")


def window(sequence: int) -> WindowMessage:
    return WindowMessage("axis-1", "b0", sequence, 0.0, 10.0, (CHANNEL,), (), 0, "", "reference", checksum((CHANNEL,)))


def parcel(sequence: int) -> Parcel:
    return Parcel("axis-1", *deflated(encode(window(sequence))), "b0", sequence)


LETTER = Parcel("axis-1", encode(HELLO))
