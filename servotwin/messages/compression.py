"""Compression of message bodies; the size after decompression is bounded in advance."""

import zlib

from servotwin.messages.checks import InvalidMessage, Refusal, require

IDENTITY, DEFLATE, ZSTD = "", "deflate", "zstd"
ENCODINGS = (IDENTITY, DEFLATE, ZSTD)
"""Names as in HTTP's Content-Encoding; the empty one is identity."""
_ZSTD_WINDOW = 8 * 1024 * 1024
"""Bytes of memory that a zstd frame may require of its reader: the limit that RFC 8878 recommends."""


def compress(data: bytes, encoding: str) -> bytes:
    """Compress with an encoding; "zstd" needs zstandard."""
    if encoding == DEFLATE:
        return zlib.compress(data, 6)
    if encoding == ZSTD:
        from zstandard import ZstdCompressor

        return ZstdCompressor().compress(data)
    return data


def decompress(data: bytes, encoding: str, limit: int) -> bytes:
    """Decompress; never more than `limit` bytes are produced.

    Raises
    ------
    InvalidMessage
        Unknown encoding, not of that encoding, cut short, followed by something else, or larger than `limit`.
    """
    require(encoding in ENCODINGS, f"content encoding {encoding[:32]!r}: known are deflate and zstd")
    if encoding == DEFLATE:
        return _inflated(data, limit)
    if encoding == ZSTD:
        return _unzstd(data, limit)
    require(len(data) <= limit, _too_large(limit), Refusal.TOO_LARGE)
    return data


def _inflated(data: bytes, limit: int) -> bytes:
    reader = zlib.decompressobj()
    try:
        inflated = reader.decompress(data, limit + 1)
    except zlib.error as error:
        raise InvalidMessage(f"body is not deflate: {error}") from None
    require(len(inflated) <= limit, _too_large(limit), Refusal.TOO_LARGE)
    require(reader.eof and not reader.unused_data, "body is not deflate: cut short, or followed by something else")
    return inflated


def _unzstd(data: bytes, limit: int) -> bytes:
    """Decompress a frame that declares its size; one without is refused, so that nothing too large is ever started."""
    import zstandard

    try:
        size = zstandard.frame_content_size(data)
        require(size >= 0, "body is not zstd: its frame does not say how many bytes it holds")
        require(size <= limit, _too_large(limit), Refusal.TOO_LARGE)
        reader = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW)
        return reader.decompress(data, max_output_size=max(1, size), read_across_frames=False, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise InvalidMessage(f"body is not zstd: {error}") from None


def _too_large(limit: int) -> str:
    return f"body holds more than {limit} bytes"
