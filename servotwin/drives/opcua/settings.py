"""Address and credentials of an OPC UA drive."""

import os
from dataclasses import dataclass, field
from pathlib import Path
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


def read_password(path: Path | None, variable: str | None) -> str | None:
    """The password in a file of mode 0600, or in an environment variable.

    Raises
    ------
    InvalidInput
        There is none, or others may read the file.
    """
    if variable is not None:
        if variable not in os.environ:
            raise InvalidInput(
                f"password_env = {variable!r} is not allowed; give the name of an environment variable that is set"
            )
        return os.environ[variable]
    if path is None:
        return None
    try:
        mode, text = path.stat().st_mode, path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        raise InvalidInput(f"password_file = {str(path)!r} is not allowed; give a text file that can be read") from None
    if mode & 0o077:
        allowed = "give a file of mode 0600: this one is open to others"
        raise InvalidInput(f"password_file = {str(path)!r} is not allowed; {allowed}")
    return text
