"""A line to an MQTT broker that loses PUBLISH packets: TCP itself does not, but what passes packets on may."""

import asyncio
from collections.abc import Callable

from relay import Reader, Relay, Writer, finish

_PUBLISH = 3


class MqttRelay(Relay):
    """Loses PUBLISH packets; counts "lost" and "passed".

    Parameters
    ----------
    target : int
        Port of the broker.
    lost : callable
        Called with the way of a PUBLISH packet ("up": to the broker; "down") and its number on that way, from 0, over
        all connections.
    """

    def __init__(self, target: int, lost: Callable[[str, int], bool]) -> None:
        super().__init__(target)
        self.lost = lost

    async def serve(self, reader: Reader, writer: Writer) -> None:
        """Pass on the packets of one connection, until either end closes."""

        async def both(back: Reader, forth: Writer) -> None:
            pumps = [
                asyncio.create_task(self._pass_on(*ends)) for ends in (("up", reader, forth), ("down", back, writer))
            ]
            try:
                await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            finally:
                await finish(*pumps)

        await self.connected(both)

    async def _pass_on(self, way: str, reader: Reader, writer: Writer) -> None:
        while True:
            packet = await _packet(reader)
            if packet[0] >> 4 == _PUBLISH:
                lost = self.lost(way, self.counts[way])
                self.counts[way] += 1
                self.counts["lost" if lost else "passed"] += 1
                if lost:
                    continue
            writer.write(packet)
            await writer.drain()


async def _packet(reader: Reader) -> bytes:
    """One control packet: a byte of type and flags, a length in up to four bytes, low ones first, and so many bytes."""
    head = bytearray(await reader.readexactly(2))
    while head[-1] & 0x80:
        head += await reader.readexactly(1)
    length = sum((byte & 0x7F) << 7 * place for place, byte in enumerate(head[1:]))
    return bytes(head) + await reader.readexactly(length)
