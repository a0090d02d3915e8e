"""Causes for which a server is not reached, in words: faults of certificates and of TLS, with the key that mends them.

OpenSSL names its own source in its messages, and no key.
"""

from __future__ import annotations

import ssl
import time
from http.client import BadStatusLine
from pathlib import Path

_OTHER_HOST = 62, 63, 64
"""OpenSSL's codes for a certificate of another host: by its name, e-mail, address."""
_NO_ISSUER = 2, 18, 19, 20, 21
"""For one without an issuer that is trusted: unknown, itself, itself at the chain's end, not found, not sent."""
_NOT_YET, _EXPIRED = 9, 10
_VERSION = ("PROTOCOL_VERSION", "UNSUPPORTED_PROTOCOL", "VERSION_TOO_LOW", "NO_PROTOCOLS_AVAILABLE")
_NO_TLS = ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "PACKET_LENGTH_TOO_LONG", "HTTP_REQUEST")
"""Parts of OpenSSL's reasons; which one it gives for an answer that is not TLS depends on its version."""


def cause_of(
    error: object, encrypted: bool, ca: str | Path | None, key: str = "ca_file", answered: bool = False
) -> str:
    """Name the cause of a failed connection.

    Parameters
    ----------
    error : exception or str
        Some libraries give a text.
    encrypted : bool
        The connection was to be one with TLS.
    ca : path, optional
        File of the certificates that are trusted; None: the system's.
    key : str
        Key or option that gives that file.
    answered : bool
        The server has answered before, so that it is one without TLS where the connection is.
    """
    if not encrypted:
        # Before a version of TLS is agreed on, a server ends the connection, or answers with an alert.
        hint = ": where its port is one with TLS, url begins with https://"
        doubtful = not answered and isinstance(error, ConnectionResetError | BadStatusLine)
        return _named(error) + (hint if doubtful else "")
    code, detail = getattr(error, "verify_code", 0), getattr(error, "verify_message", "")
    if code in (_NOT_YET, _EXPIRED):
        state = "has expired" if code == _EXPIRED else "is not yet valid"
        return f"a certificate {state}; the clock of this computer says {time.strftime('%Y-%m-%d', time.gmtime())}"
    if code in _OTHER_HOST:
        return f"its certificate is for another host than that of url ({detail.rstrip('.')})"
    if code in _NO_ISSUER and ca is None:
        return f"its certificate is signed by none that this computer trusts ({detail}): give its issuer's with {key}"
    if code in _NO_ISSUER:
        return f"what the server shows does not lead to one of {key} {ca} ({detail})"
    if code:
        return f"its certificate is not accepted ({detail})"
    return _fault_of_tls(error)


def is_of_certificate(error: object) -> bool:
    """True where a connection failed because the server's certificate was not accepted."""
    return isinstance(error, ssl.SSLCertVerificationError)


def _fault_of_tls(error: object) -> str:
    """Name the cause of a failed handshake whose certificate is not to blame."""
    reason = getattr(error, "reason", None) or ""
    if any(part in reason for part in _VERSION):
        return "there is no version of TLS that both allow: here 1.2 and later"
    if any(part in reason for part in _NO_TLS):
        return "its port does not answer with TLS"
    if isinstance(error, TimeoutError) and "handshake" in str(error):
        return "the server does not end the TLS handshake"
    if isinstance(error, ssl.SSLEOFError | ssl.SSLZeroReturnError):
        return "the server ended the encrypted connection"
    if isinstance(error, ssl.SSLError) and reason:
        return f"TLS failed ({reason.lower().replace('_', ' ')})"
    return _named(error)


def _named(error: object) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return error if isinstance(error, str) else f"{type(error).__name__}: {error}"
