"""Authentication and authorisation: tokens, the file of their digests, and files that only their owner may read.

A servo's token speaks for that servo; an operator's token reads everything; an engineer's also holds machines,
approves versions and rolls them back.
"""

from __future__ import annotations

import hmac
import logging
import os
import re
import secrets
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from servotwin.config.files import check_private
from servotwin.config.table import Table, check_complete, read_toml, with_end
from servotwin.errors import InvalidInput
from servotwin.link.seal import MAX_TOKEN, verifier_of
from servotwin.messages import NAME_PATTERN, Refusal
from servotwin.runtime.files import replace_file
from servotwin.runtime.locks import lock_beside, locked
from servotwin.twin_service.limits import RateLimiter, RequestRejected

log = logging.getLogger(__name__)

PRIVATE = 0o600
"""Mode of files that only their owner may read."""
_HEAD = "# Digests of tokens: keep this file as secret as the tokens themselves.\n"
_VERIFIER = re.compile(r"[0-9a-f]{64}")
_NO_VERIFIER = bytes(32)
"""Verifier of no token. A servo without a token is compared with it, so that a guess takes as long."""
_OPEN = verifier_of("")
"""Verifier of the empty token, which seals messages where no tokens are configured."""
_MISSING = "a token is needed: Authorization: Bearer TOKEN"
_WRONG = "the token is not that of this servo"
_FOREIGN = "the token belongs to another name: it may not do this"


@dataclass(frozen=True)
class Verifiers:
    """Digests of the valid tokens.

    Attributes
    ----------
    servos, operators, engineers : mapping of str to bytes
        Name to `link.seal.verifier_of` its token.
    fleet : str
        Name that `servotwin enroll` draws for the file, and that the twin's store keeps; empty: not named yet.
    """

    servos: Mapping[str, bytes] = field(default_factory=dict)
    operators: Mapping[str, bytes] = field(default_factory=dict)
    engineers: Mapping[str, bytes] = field(default_factory=dict)
    fleet: str = field(default="", compare=False)

    def __repr__(self) -> str:
        counts = f"{len(self.servos)} servos, {len(self.operators)} operators, {len(self.engineers)} engineers"
        return f"Verifiers({counts})"

    @property
    def readers(self) -> Mapping[str, bytes]:
        """Operators and engineers: whoever reads everything."""
        return {**self.operators, **self.engineers}


class AccessControl:
    """Checks tokens.

    Parameters
    ----------
    verifiers : Verifiers or None
        None: nobody needs a token.
    """

    def __init__(self, verifiers: Verifiers | None) -> None:
        self.replace(verifiers)

    def replace(self, verifiers: Verifiers | None) -> None:
        """Replace the verifiers."""
        self._verifiers = verifiers
        self._readers = {} if verifiers is None else verifiers.readers
        servos = () if verifiers is None else verifiers.servos.values()
        self._known = frozenset((*servos, *self._readers.values()))
        self._servo_of = {} if verifiers is None else {each: name for name, each in verifiers.servos.items()}

    def check_servo(self, servo: str, token: bytes | None) -> None:
        """Check that a token is that of a servo.

        Raises
        ------
        RequestRejected
            401 without a token or with an unknown one, 403 with another's.
        """
        if self._verifiers is None:
            return
        verifier = _digest(token)
        if not hmac.compare_digest(verifier, self._verifiers.servos.get(servo, _NO_VERIFIER)):
            raise self._rejected(verifier, _WRONG)

    def check_operator(self, token: bytes | None) -> None:
        """Check that a token is an operator's or an engineer's; raises RequestRejected as `check_servo` does."""
        if self._verifiers is None:
            return
        verifier = _digest(token)
        # Every operator is compared: a loop that ended at a match would tell by its time which one it was.
        matches = [hmac.compare_digest(verifier, known) for known in self._readers.values()]
        if not any(matches):
            raise self._rejected(verifier, "the token is not an operator's")

    def knows(self, token: bytes | None) -> bool:
        """Test whether a token is anybody's."""
        try:
            return _digest(token) in self._known
        except RequestRejected:
            return False

    def servo_of(self, token: bytes | None) -> str:
        """Name of the servo with a token; empty: it is no servo's."""
        try:
            return self._servo_of.get(_digest(token), "")
        except RequestRejected:
            return ""

    def owner_of(self, token: bytes | None) -> str:
        """Name of the servo, operator or engineer with a token; empty: it is nobody's."""
        servo = self.servo_of(token)
        return servo if servo or not self.knows(token) else f"operator {self.operator_of(token)}"

    @property
    def open(self) -> bool:
        """True where nobody needs a token."""
        return self._verifiers is None

    def operator_of(self, token: bytes | None) -> str:
        """Name of the operator or engineer with a token; empty: it is nobody's of them."""
        verifier, found = _digest(token), ""
        for name, known in self._readers.items():
            if hmac.compare_digest(verifier, known):
                found = name
        return found

    def operator_key(self, name: str) -> bytes:
        """Key that only the service and the holder of an operator's token can make; random where there is none."""
        known = self._readers.get(name)
        return secrets.token_bytes(32) if known is None else known

    def is_engineer(self, name: str) -> bool:
        """True for the name of an engineer."""
        return self._verifiers is not None and name in self._verifiers.engineers

    def verifier(self, servo: str) -> bytes | None:
        """Verifier with which messages to a servo are sealed; None: its token was revoked."""
        return _OPEN if self._verifiers is None else self._verifiers.servos.get(servo)

    def _rejected(self, verifier: bytes, detail: str) -> RequestRejected:
        if verifier in self._known:
            return RequestRejected(Refusal.BAD_TOKEN, _FOREIGN, 403)
        return RequestRejected(Refusal.BAD_TOKEN, detail, 401)


class EdgeGate:
    """Checks of a request for a servo that come before its body is read: token, name and message rate.

    Parameters
    ----------
    access : AccessControl
    has_servo : callable
        Test whether a servo of that name belongs to this twin.
    messages, polls : RateLimiter
    """

    def __init__(
        self, access: AccessControl, has_servo: Callable[[str], bool], messages: RateLimiter, polls: RateLimiter
    ) -> None:
        self._access, self._has_servo = access, has_servo
        self._messages, self._polls = messages, polls

    def admit(self, servo: str, token: bytes | None, *, limited: bool = True) -> None:
        """Check the token, the name and, if `limited`, the message rate of a servo; raises RequestRejected."""
        self._access.check_servo(servo, token)
        self._admit(servo, self._messages if limited else None)

    def admit_poll(self, servo: str, token: bytes | None) -> None:
        """Check the token, the name and the rate of polls of a servo; raises RequestRejected."""
        self._access.check_servo(servo, token)
        self.admit_authenticated_poll(servo)

    def admit_authenticated(self, servo: str, *, limited: bool = True) -> None:
        """`admit` for a servo whose seal was checked already."""
        self._admit(servo, self._messages if limited else None)

    def admit_authenticated_poll(self, servo: str) -> None:
        """`admit_poll` for a servo whose seal was checked already."""
        self._admit(servo, self._polls)

    def _admit(self, servo: str, limiter: RateLimiter | None) -> None:
        if not self._has_servo(servo):
            raise RequestRejected(Refusal.UNKNOWN_SERVO, f"this twin has no servo {servo[:64]!r}")
        if limiter is not None:
            limiter.take(servo)

    def find_verifier(self, servo: str) -> bytes | None:
        """Verifier of a servo's token; None: it has none."""
        return self._access.verifier(servo)

    def verifier(self, servo: str) -> bytes:
        """Verifier with which messages to the servo are sealed; raises RequestRejected where its token was revoked."""
        verifier = self._access.verifier(servo)
        if verifier is None:
            raise RequestRejected(Refusal.BAD_TOKEN, "the token of this servo was revoked")
        return verifier


class TokenFile:
    """Reloads the file of tokens when it is replaced, so that `servotwin enroll` needs no restart.

    An invalid file changes nothing: the tokens that were read last stay valid.

    Attributes
    ----------
    fault : str
        Sentence on what is wrong with the file that is there now; empty: nothing.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.fault = path, ""
        # Taken before the file is read: a file that is replaced meanwhile is then read again.
        self._stamp = self._stat()
        self.access = AccessControl(read_tokens(path))

    def refresh(self) -> bool:
        """Read the file again if it was replaced; returns whether its tokens were adopted."""
        stamp = self._stat()
        if stamp == self._stamp:
            return False
        self._stamp = stamp
        try:
            self.access.replace(read_tokens(self.path))
        except (InvalidInput, OSError) as error:
            self.fault = str(error)
            log.error("tokens not reloaded: the former ones stay", extra={"why": self.fault})
            return False
        self.fault = ""
        log.info("tokens reloaded")
        return True

    def _stat(self) -> tuple[int, int, int] | None:
        try:
            status = self.path.stat()
        except OSError:
            return None
        return status.st_ino, status.st_mtime_ns, status.st_size


def bearer_token(header: bytes | None) -> bytes | None:
    """Token in an Authorization header; None: there is none."""
    if header is None or header[:7].lower() != b"bearer ":
        return None
    return header[7:].strip() or None


def _digest(token: bytes | None) -> bytes:
    if token is None:
        raise RequestRejected(Refusal.BAD_TOKEN, _MISSING)
    if len(token) > MAX_TOKEN or not token.isascii():
        raise RequestRejected(Refusal.BAD_TOKEN, "the token is not one that this service issues")
    return verifier_of(token.decode("ascii"))


def read_tokens(path: Path) -> Verifiers:
    """Read the verifiers in a file of mode 0600.

    Raises
    ------
    InvalidInput
        The file cannot be read, is readable by others, is empty or cut short, or holds something that is not a name or
        not a verifier. The message does not repeat its content.
    """
    if not path.exists():
        raise InvalidInput(f"{path}: there is no such file of tokens; `servotwin enroll` makes it")
    check_private(path)
    if not path.read_bytes().strip():
        raise InvalidInput(f"{path}: is empty; copy it again, or remove it, so that `servotwin enroll` makes a new one")
    check_complete(path, "copy it again")
    table = read_toml(path)
    servos, operators, engineers = (_read_verifiers(table.table(name)) for name in ("servos", "operators", "engineers"))
    verifiers = Verifiers(servos, operators, engineers, _read_fleet(table))
    table.done()
    if both := sorted(operators.keys() & engineers.keys()):
        raise InvalidInput(f"{path}: {both[0]!r} is an operator and an engineer; keep one of the two")
    owner: dict[bytes, str] = {}
    for name, verifier in [*servos.items(), *verifiers.readers.items()]:
        if verifier in owner:
            raise InvalidInput(f"{path}: {owner[verifier]!r} and {name!r} have the same token")
        owner[verifier] = name
    return verifiers


def write_tokens(path: Path, verifiers: Verifiers) -> None:
    """Replace the file atomically, mode 0600; raises InvalidInput where that fails."""
    tables = {"servos": verifiers.servos, "operators": verifiers.operators}
    if verifiers.engineers:  # a file without them stays one that earlier versions read
        tables["engineers"] = verifiers.engineers
    parts = [
        f"[{name}]\n" + "".join(f'"{key}" = "{value.hex()}"\n' for key, value in sorted(entries.items()))
        for name, entries in tables.items()
    ]
    fleet = f'fleet = "{verifiers.fleet or secrets.token_hex(8)}"\n'
    write_private(path, with_end("\n".join([_HEAD + fleet, *parts])))


@contextmanager
def tokens_locked(path: Path) -> Iterator[None]:
    """Hold the lock of a file of tokens, to read and replace it; raises InvalidInput where no lock can be made.

    A wait of more than a second is said on the standard error.
    """
    with ExitStack() as stack:
        try:
            lock = stack.enter_context(locked(lock_beside(path), wait=True, waiting=partial(_say_waiting, path)))
            os.ftruncate(lock, 0)
            os.pwrite(lock, b"%d" % os.getpid(), 0)  # for the sentence of those that wait
        except OSError as error:
            raise InvalidInput(f"{lock_beside(path)}: cannot be made ({error.strerror})") from None
        yield


def _say_waiting(path: Path, lock: int) -> None:
    holder = os.pread(lock, 20, 0).decode(errors="replace")
    who = f"process {holder}" if holder.isdecimal() else "another process"
    print(f"{path}: locked by {who}, an enrolment or revocation; waiting for its end", file=sys.stderr, flush=True)


def _read_fleet(table: Table) -> str:
    fleet = table.values.get("fleet", "")
    table.known("fleet")
    if not isinstance(fleet, str) or (fleet and re.fullmatch(NAME_PATTERN, fleet) is None):
        raise InvalidInput(f"{table.source}: fleet is no name: 1 to 64 letters, digits, . _ or -")
    return fleet


def _read_verifiers(table: Table) -> dict[str, bytes]:
    return {name: _read_verifier(table, name) for name in table.values}


def _read_verifier(table: Table, name: str) -> bytes:
    if re.fullmatch(NAME_PATTERN, name) is None:
        raise InvalidInput(
            f"{table.source}: [{table.name}] has an entry {name[:80]!r}: a name has 1 to 64 letters, digits, . _ or -"
        )
    value = table.values[name]
    if not isinstance(value, str) or _VERIFIER.fullmatch(value) is None:
        raise InvalidInput(
            f"{table.source}: {table.path(name)} is no verifier: `servotwin enroll` writes 64 hex digits"
        )
    return bytes.fromhex(value)


def write_private(path: Path, text: str, durable: bool = True) -> None:
    """Write a file of mode 0600 atomically and, by default, durably; raises InvalidInput where that fails."""
    try:
        replace_file(path, text.encode(), durable=durable, mode=PRIVATE)
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be written ({error.strerror or error})") from None
