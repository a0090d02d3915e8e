"""Properties of a URL: local, encrypted, in clear."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit


def is_here(host: str) -> bool:
    """True where a host's name or number means this machine."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_encrypted(url: str) -> bool:
    """True where the connection is encrypted, however the scheme is written."""
    return urlsplit(url).scheme in ("https", "mqtts")


def in_clear(url: str) -> bool:
    """True where a network carries data unencrypted: everybody on it could read a token."""
    parts = urlsplit(url)
    return parts.scheme == "http" and not is_here(parts.hostname or "")
