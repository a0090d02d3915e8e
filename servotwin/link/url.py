"""Properties of a URL (local, encrypted, in clear), and the TLS context of an encrypted one."""

from __future__ import annotations

import ipaddress
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar
from urllib.parse import urlsplit

from servotwin.config.named_file import check_named
from servotwin.config.table import Table
from servotwin.errors import InvalidInput

if TYPE_CHECKING:
    import ssl

_Path = TypeVar("_Path", str, Path)


def is_here(host: str) -> bool:
    """True where a host's name or address means this machine."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_encrypted(url: str) -> bool:
    """True where the connection is encrypted; capitals in the scheme do not matter."""
    return urlsplit(url).scheme in ("https", "mqtts")


def in_clear(url: str) -> bool:
    """True where a network carries data unencrypted: everybody on it could read a token."""
    parts = urlsplit(url)
    return parts.scheme == "http" and not is_here(parts.hostname or "")


def certificates(_table: Table, _name: str, path: _Path, _folder: Path) -> _Path:
    """Return the path of a file of certificates, for `config.keys.key(parse=...)`; raises as `tls_context` does."""
    tls_context(str(path))
    return path


def system_certificates() -> Path | None:
    """File of the certificates that this computer trusts, which a context reads once; None: it has none."""
    import ssl  # as below

    found = ssl.get_default_verify_paths().cafile
    return None if found is None else Path(found)


def tls_context(ca_file: str | None) -> ssl.SSLContext:
    """Make the context of a client that checks certificates against those of a file; None: the system's.

    Raises
    ------
    InvalidInput
        The file cannot be read, is no file, or holds no certificates.
    """
    import ssl  # the edge's control process, which has no TLS, does without it

    if ca_file is not None:
        check_named(ca_file)
    try:
        return ssl.create_default_context(cafile=ca_file)
    except OSError as error:  # ssl.SSLError is one
        reason = error.strerror or error
        raise InvalidInput(f"{ca_file}: holds no certificates that can be read ({reason}); give a PEM file") from None


def read_again(context: ssl.SSLContext, ca_file: str | None) -> None:
    """Trust also what the file of certificates, or the system's, holds now; one that is being replaced changes nothing.

    What the context trusted before it goes on trusting.
    """
    with suppress(OSError):
        if ca_file is None:
            context.load_default_certs()
        else:
            context.load_verify_locations(ca_file)
