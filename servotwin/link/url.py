"""What an address tells of the way to it."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit


def is_here(host: str) -> bool:
    """Whether a host's name or number means this machine itself."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_encrypted(url: str) -> bool:
    """Whether the way there is, however the scheme is written."""
    return urlsplit(url).scheme in ("https", "mqtts")


def in_clear(url: str) -> bool:
    """Whether a network carries what is sent there unencrypted: a token would be read by everybody on it."""
    parts = urlsplit(url)
    return parts.scheme == "http" and not is_here(parts.hostname or "")
