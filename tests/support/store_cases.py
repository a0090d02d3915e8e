"""Messages and work results for tests of the store; their contents have no meaning."""

import hashlib
import itertools
import os
from collections.abc import Callable
from pathlib import Path

from postgres import Server

from servotwin.store.records import EvidenceRecord, Incoming, Lease, MessageKind, WorkResult
from servotwin.store.schema import REVISION
from servotwin.store.store import Store, open_store

SYSTEMS = ("sqlite", "postgresql")
NewAddress = Callable[[], str]
"""URL of a new, empty database."""

NEXT = f"{int(REVISION) + 1:04d}"
MORE = f"""
import sqlalchemy as sa
from alembic import op
revision = "{NEXT}"
down_revision = "{REVISION}"
def upgrade():
    op.add_column("twins", sa.Column("colour", sa.Text, nullable=False, server_default="grey"))
"""

_numbers = itertools.count()


def sqlite_addresses(folder: Path) -> NewAddress:
    """Addresses of files in a folder."""
    return lambda: f"sqlite:///{folder}/store-{next(_numbers)}.db"


def postgresql_addresses(server: Server) -> NewAddress:
    """Addresses on a server."""
    return lambda: server.database(f"store{next(_numbers)}")


def incoming(
    servo: str, key: str, body: bytes, kind: MessageKind, received: float = 100.0, encoding: str = ""
) -> Incoming:
    return Incoming(servo, kind, key, body, encoding, hashlib.sha256(body).digest(), received)


def window(servo: str = "a", sequence: int = 1, body: bytes = b"samples", received: float = 100.0) -> Incoming:
    plain = incoming(servo, f"boot/{sequence}", body, MessageKind.WINDOW, received)
    return plain._replace(boot="boot", sequence=sequence, start=2.0 * sequence)


def letter(servo: str = "a", body: bytes = b"hello", received: float = 100.0) -> Incoming:
    return incoming(servo, hashlib.sha256(body).hexdigest(), body, MessageKind.LETTER, received)


def verification(servo: str = "a", body: bytes = b"prove it", received: float = 100.0) -> Incoming:
    return incoming(servo, f"verification {body!r}", body, MessageKind.VERIFICATION, received)


def outcome(claim: Lease, *evidence: EvidenceRecord, outgoing: tuple[bytes, ...] = (), **other: object) -> WorkResult:
    """One that covers everything of a claim."""
    done = tuple(message.id for message in claim.messages)
    values = {"state": b"state", "wake": None} | other
    return WorkResult(claim.servo, claim.serial, done=done, evidence=evidence, outgoing=outgoing, **values)


def bodies_of(claim: Lease) -> list[bytes]:
    return [message.body for message in claim.messages]


def claim(store: Store, owner: str = "me", now: float = 200.0, **more: object) -> list[Lease]:
    return store.lease(owner, more.pop("limit", 10), more.pop("lease_s", 30.0), now, **more)


def filled(url: str, windows: int = 5) -> Store:
    """A new store with some windows."""
    store = open_store(url)
    store.put([window(sequence=n, body=os.urandom(3000), received=100.0 + n) for n in range(windows)])
    return store
