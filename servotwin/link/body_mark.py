"""What a twin tells over HTTP of a body that came to it, so that an edge knows that its own was judged.

A proxy may cut or change a body on its way, swap answers of two requests, or answer itself.
"""

import zlib


def body_mark(body: bytes, encoding: str) -> str:
    """Mark of a body and of the compression that its headers state, equal where both came through unchanged."""
    return f"{zlib.crc32(body):08x} {encoding}"
