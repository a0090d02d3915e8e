"""Address and credentials of an OPC UA drive."""

import asyncio
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from servotwin.drives.opcua.model import OBJECT
from servotwin.errors import InvalidInput

LOOPBACK = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True)
class OpcUaSettings:
    """Address and credentials of an OPC UA drive.

    Parameters
    ----------
    url : str
        opc.tcp://HOST:PORT[/PATH].
    node : str
        Browse name of the drive's object below Objects, in the model's namespace.
    user, password : str, optional
        Both or neither; without certificates on this machine only, since the password would be read on its way.
    certificate, private_key, server_certificate : Path, optional
        All or none, PEM or DER: messages are signed and encrypted (Basic256Sha256), and the server must hold the
        private key of its certificate.
    poll_s : float
        Interval between two readings of the samples, s; the rings must hold several times as much.
    silence_s : float
        s without an answer, or a new sample, after which the drive counts as lost.
    """

    url: str
    node: str = OBJECT
    user: str | None = None
    password: str | None = field(default=None, repr=False)
    certificate: Path | None = None
    private_key: Path | None = None
    server_certificate: Path | None = None
    poll_s: float = 0.05
    silence_s: float = 5.0

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme != "opc.tcp" or not parts.hostname or parts.username is not None:
            raise InvalidInput(
                f"url = {self.url!r} is not allowed; give opc.tcp://HOST:PORT, and a user by its own key"
            )
        if (self.user is None) != (self.password is None):
            raise InvalidInput("user and password_file (or password_env): both are needed, or neither")
        secured = [value is not None for value in (self.certificate, self.private_key, self.server_certificate)]
        if any(secured) != all(secured):
            raise InvalidInput("certificate, private_key and server_certificate: all of them are needed, or none")
        if not any(secured) and parts.hostname not in LOOPBACK:
            raise InvalidInput(
                f"url = {self.url!r}: beyond this machine certificate, private_key and server_certificate are needed"
            )


def check_certificate(path: Path) -> None:
    """Check that a file holds a certificate; raises InvalidInput."""
    _check(path, "load_certificate", "certificate")


def check_private_key(path: Path) -> None:
    """Check that a file holds a private key without a password; raises InvalidInput."""
    _check(path, "load_private_key", "private key without a password")


def _check(path: Path, load: str, what: str) -> None:
    """Load a file as the client does, which takes NAME.pem for PEM and any other for DER."""
    try:
        from asyncua.crypto import uacrypto
    except ModuleNotFoundError:
        return  # the drive says so
    loader: Any = getattr(uacrypto, load)
    try:
        asyncio.run(loader(path))
    except (ValueError, TypeError):
        raise InvalidInput(f"{path}: holds no {what}; give NAME.pem in PEM, or another in DER") from None
