"""Who may do what: a servo's token speaks for that servo, an operator's reads everything."""

from __future__ import annotations

import hmac
import logging
from pathlib import Path

from servotwin.errors import InvalidInput
from servotwin.link.seal import verifier_of
from servotwin.messages import Refusal
from servotwin.twin_service.refused import Refused
from servotwin.twin_service.tokens import Verifiers, read_tokens

log = logging.getLogger(__name__)

NOBODY = bytes(32)
"""No token has this verifier: compared with where there is none, so that a guess takes as long."""
OPEN = verifier_of("")
"""Seals messages where there are no tokens: an edge without a token has the empty one."""
LONGEST = 1024
"""Characters of a token at most."""
_MISSING = "a token is needed: Authorization: Bearer TOKEN"
_WRONG = "the token is not that of this servo"
_FOREIGN = "the token belongs to another name: it may not do this"


class Authority:
    """Checks tokens.

    Parameters
    ----------
    verifiers : Verifiers or None
        None: nobody needs a token.
    """

    def __init__(self, verifiers: Verifiers | None) -> None:
        self.adopt(verifiers)

    def adopt(self, verifiers: Verifiers | None) -> None:
        """From now on these count."""
        self._verifiers = verifiers
        known = [] if verifiers is None else [*verifiers.servos.values(), *verifiers.operators.values()]
        self._known = frozenset(known)

    def admit_servo(self, servo: str, token: bytes | None) -> None:
        """Let a servo's own token speak for it.

        Raises
        ------
        Refused
            401 without a token or with an unknown one, 403 with another's.
        """
        if self._verifiers is None:
            return
        verifier = _digest(token)
        if not hmac.compare_digest(verifier, self._verifiers.servos.get(servo, NOBODY)):
            raise self._refused(verifier, _WRONG)

    def admit_operator(self, token: bytes | None) -> None:
        """Let an operator's token read everything; raises Refused as `admit_servo` does."""
        if self._verifiers is None:
            return
        verifier = _digest(token)
        matches = [hmac.compare_digest(verifier, known) for known in self._verifiers.operators.values()]
        if not any(matches):
            raise self._refused(verifier, "the token is not an operator's")

    def verifier(self, servo: str) -> bytes | None:
        """With which messages to a servo are sealed; None where it has no token any more."""
        return OPEN if self._verifiers is None else self._verifiers.servos.get(servo)

    def _refused(self, verifier: bytes, wrong: str) -> Refused:
        known = verifier in self._known
        return Refused(Refusal.BAD_TOKEN, _FOREIGN if known else wrong, 403 if known else 401)


class TokenFile:
    """Follows the file of tokens, so that `servotwin enroll` needs no restart; a broken one changes nothing."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # First: what is written while it is read is then read again.
        self._seen = self._stamp()
        self.authority = Authority(read_tokens(path))

    def refresh(self) -> bool:
        """Read the file again if it was replaced; whether it counts now."""
        stamp = self._stamp()
        if stamp == self._seen:
            return False
        self._seen = stamp
        try:
            self.authority.adopt(read_tokens(self.path))
        except (InvalidInput, OSError) as error:
            log.error("tokens not read again: the former ones stay", extra={"why": str(error)})
            return False
        log.info("tokens read again")
        return True

    def _stamp(self) -> tuple[int, int, int] | None:
        try:
            found = self.path.stat()
        except OSError:
            return None
        return found.st_ino, found.st_mtime_ns, found.st_size


def bearer(header: bytes | None) -> bytes | None:
    """The token in an Authorization header; None: there is none."""
    if header is None or header[:7].lower() != b"bearer ":
        return None
    return header[7:].strip() or None


def _digest(token: bytes | None) -> bytes:
    if token is None:
        raise Refused(Refusal.BAD_TOKEN, _MISSING)
    if len(token) > LONGEST or not token.isascii():
        raise Refused(Refusal.BAD_TOKEN, "the token is not one that this service gives out")
    return verifier_of(token.decode("ascii"))
