"""Expiry of the twin's TLS certificate, told before edges and browsers refuse it."""

from __future__ import annotations

import asyncio
import logging
import ssl
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from servotwin.twin_service.config import ServiceConfig

log = logging.getLogger(__name__)

_DAY = 86400.0
_WARNED_S, _WATCH_S = 14.0 * _DAY, 3600.0
"""s before the expiry from which on it is told, and between two looks at the clock."""
_UTC_TIME, _VERSION = 0x17, 0xA0
_END = "-----END CERTIFICATE-----"


class CertificateExpiry:
    """Time until which the certificate that the twin shows is valid: that of the file at the start.

    Parameters
    ----------
    config : ServiceConfig
    wall : callable
        s since the epoch.
    """

    def __init__(self, config: ServiceConfig, wall: Callable[[], float]) -> None:
        self._path, self._wall = config.tls_certificate, wall
        self._until: float | None = None
        if self._path is not None:
            # One in another form that the server can show is no reason not to start.
            with suppress(ValueError, IndexError):
                self._until = valid_until(self._path)

    def sentences(self) -> list[str]:
        """Return a sentence where the certificate has expired, or will within two weeks."""
        if self._until is None or self._wall() < self._until - _WARNED_S:
            return []
        expired = self._wall() >= self._until
        when = datetime.fromtimestamp(self._until, UTC).strftime("%Y-%m-%d %H:%M UTC")
        state = "has expired on" if expired else "expires on"
        refused = (
            "edges and browsers refuse this twin" if expired else "from then on edges and browsers refuse this twin"
        )
        return [f"tls_certificate {self._path} {state} {when}: {refused}; renew it, and restart the twin"]

    async def watch(self, announce: Callable[[str, str], None]) -> None:
        """Log and announce the sentence when it begins to hold, and when it changes."""
        before: list[str] = []
        while True:
            found = self.sentences()
            if found and found != before:
                log.warning("certificate expires", extra={"why": found[0]})
                announce("certificate", found[0])
            before = found
            await asyncio.sleep(_WATCH_S)


def valid_until(path: Path) -> float:
    """Time at which the first certificate of a PEM file expires, s since the epoch (RFC 5280, 4.1).

    Raises
    ------
    ValueError
        The file holds no certificate.
    """
    first, found, _ = path.read_text(encoding="ascii", errors="replace").partition(_END)
    der = ssl.PEM_cert_to_DER_cert(first[first.find("-----BEGIN CERTIFICATE-----") :] + found)
    _, to_be_signed, _ = _element(der, 0)
    _, place, _ = _element(der, to_be_signed)
    before = 4 if der[place] == _VERSION else 3  # version, serial number, signature, issuer
    for _ in range(before):
        _, _, place = _element(der, place)
    _, not_before, _ = _element(der, place)
    _, _, not_after = _element(der, not_before)
    tag, begin, end = _element(der, not_after)
    form = "%y%m%d%H%M%SZ" if tag == _UTC_TIME else "%Y%m%d%H%M%SZ"
    return datetime.strptime(der[begin:end].decode("ascii"), form).replace(tzinfo=UTC).timestamp()


def _element(der: bytes, place: int) -> tuple[int, int, int]:
    """(tag, begin, end) of the content of the DER element that begins at a place."""
    length, begin = der[place + 1], place + 2
    if length & 0x80:
        size = length & 0x7F
        length = int.from_bytes(der[begin : begin + size], "big")
        begin += size
    return der[place], begin, begin + length
