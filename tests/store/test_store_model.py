"""The store against a model in a dict, for any order of messages, leases, expiries, results and restarts."""

import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from exploration import examples
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, invariant, multiple, rule
from store_cases import incoming

from servotwin.store.records import EvidenceRecord, Incoming, Lease, MessageKind, OutgoingMessage, PutResult, WorkResult
from servotwin.store.store import WORK_KINDS, open_store

LEASE_S = 10.0
QUEUES = {
    WORK_KINDS,
    (MessageKind.VERIFICATION,),
    (*WORK_KINDS, MessageKind.VERIFICATION),
}

servos = st.sampled_from(["a", "b", "c"])
keys = st.sampled_from([f"k{n}" for n in range(8)])
texts = st.sampled_from([b"x", b"y"])


@dataclass
class Model:
    """Expected state of a servo."""

    state: bytes = b""
    serial: int = 0
    wake: float | None = None
    lent_until: float | None = None
    letters: list[bytes] = field(default_factory=list)


@dataclass
class Kept:
    item: Incoming
    done: bool = False


class Against(RuleBasedStateMachine):
    claims = Bundle("claims")

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.store = open_store(str(self.folder / "store.db"))
        self.now = 1000.0
        self.servos: dict[str, Model] = {}
        self.kept: dict[tuple[str, str], Kept] = {}

    def teardown(self) -> None:
        self.store.close()
        shutil.rmtree(self.folder)

    @rule(items=st.lists(st.tuples(servos, keys, texts, st.sampled_from(MessageKind)), min_size=1, max_size=5))
    def put(self, items: list[tuple[str, str, bytes, MessageKind]]) -> None:
        # A key is of one kind for ever, as a boot and a sequence are.
        made = [incoming(s, f"{kind} {key}", body, kind, self.now) for s, key, body, kind in items]
        assert self.store.put(made) == [self.expect_put(item) for item in made]

    def expect_put(self, item: Incoming) -> PutResult:
        self.servos.setdefault(item.servo, Model())
        kept = self.kept.setdefault((item.servo, item.key), Kept(item))
        if kept.item is item:
            return PutResult.NEW
        return PutResult.KNOWN if kept.item.digest == item.digest else PutResult.CONFLICT

    def undone(self, servo: str, kinds: tuple[MessageKind, ...]) -> list[bytes]:
        of = (kept.item for (whose, _), kept in self.kept.items() if whose == servo and not kept.done)
        return [item.body + item.key.encode() for item in of if item.kind in kinds]

    def due(self, servo: str, kinds: tuple[MessageKind, ...]) -> bool:
        model = self.servos[servo]
        if model.lent_until is not None and model.lent_until > self.now:
            return False
        woken = model.wake is not None and model.wake <= self.now and MessageKind.WINDOW in kinds
        return woken or bool(self.undone(servo, kinds))

    @rule(target=claims, limit=st.integers(1, 3), per_servo=st.integers(1, 4), kinds=st.sampled_from(sorted(QUEUES)))
    def claim(self, limit: int, per_servo: int, kinds: tuple[MessageKind, ...]) -> object:
        due = {servo for servo in self.servos if self.due(servo, kinds)}
        result = self.store.lease("me", limit, LEASE_S, self.now, kinds, per_servo)
        assert {one.servo for one in result} <= due
        assert len(result) == min(limit, len(due))
        for one in result:
            self.check(one, kinds, per_servo)
            self.servos[one.servo].lent_until = self.now + LEASE_S
        return multiple(*result)

    def check(self, claim: Lease, kinds: tuple[MessageKind, ...], per_servo: int) -> None:
        model = self.servos[claim.servo]
        assert (claim.state, claim.serial) == (model.state, model.serial)
        expected = self.undone(claim.servo, kinds)
        bodies = [self.body_of(claim.servo, message.id) for message in claim.messages]
        if kinds == WORK_KINDS or MessageKind.WINDOW not in kinds:
            assert bodies == expected[:per_servo]
        else:
            assert len(bodies) == len(set(bodies)) <= 2 * per_servo
            assert set(bodies) <= set(expected)

    def body_of(self, servo: str, message: int) -> bytes:
        with self.store.engines.reader.begin() as connection:
            query = "SELECT body, key FROM messages JOIN bodies ON message = id WHERE id = ? AND servo = ?"
            body, key = connection.exec_driver_sql(query, (message, servo)).one()
        return body + key.encode()

    @rule(
        leased=st.lists(consumes(claims), min_size=1, max_size=3),
        letters=st.lists(texts, max_size=2),
        wake=st.none() | st.floats(0.0, 30.0),
        ask=st.none() | keys,
        again=st.booleans(),
    )
    def commit(
        self, leased: list[Lease], letters: list[bytes], wake: float | None, ask: str | None, again: bool
    ) -> None:
        made = [self.outcome(claim, letters, wake, ask) for claim in leased]
        made += made[:1] if again else []
        assert self.store.commit(made, self.now) == [self.expect_commit(one) for one in made]

    def outcome(self, claim: Lease, letters: list[bytes], wake: float | None, ask: str | None) -> WorkResult:
        done = tuple(message.id for message in claim.messages)
        result = tuple(EvidenceRecord("estimate", message, b"") for message in done)
        enqueued = (
            ()
            if ask is None
            else (incoming(claim.servo, f"{MessageKind.VERIFICATION} {ask}", b"x", MessageKind.VERIFICATION, self.now),)
        )
        at = None if wake is None else self.now + wake
        return WorkResult(claim.servo, claim.serial, b"%d" % claim.serial, at, done, result, tuple(letters), enqueued)

    def expect_commit(self, made: WorkResult) -> bool:
        model = self.servos[made.servo]
        if model.serial != made.serial:
            return False
        for message in made.done:
            key = self.key_of(message)
            assert not self.kept[made.servo, key].done, "done twice"
            self.kept[made.servo, key].done = True
        for item in made.enqueue:
            self.expect_put(item)
        model.state, model.serial, model.wake, model.lent_until = made.state, made.serial + 1, made.wake, None
        model.letters += made.outgoing
        return True

    def key_of(self, message: int) -> str:
        with self.store.engines.reader.begin() as connection:
            return connection.exec_driver_sql("SELECT key FROM messages WHERE id = ?", (message,)).scalar_one()

    @rule(seconds=st.floats(0.0, 15.0))
    def time_passes(self, seconds: float) -> None:
        self.now += seconds

    @rule()
    def release(self) -> None:
        self.store.release("me")
        for model in self.servos.values():
            model.lent_until = None

    @rule()
    def restart(self) -> None:
        self.store.close()
        self.store = open_store(str(self.folder / "store.db"))

    @invariant()
    def it_tells_the_same(self) -> None:
        for name, model in self.servos.items():
            result = self.store.servo(name)
            assert (result.serial, result.wake) == (model.serial, model.wake)
            assert result.waiting == len(self.undone(name, WORK_KINDS))
            assert self.store.outgoing(name, 0) == [OutgoingMessage(n, body) for n, body in enumerate(model.letters, 1)]
        waiting = self.store.backlog(self.now)
        assert waiting.messages == sum(len(self.undone(name, WORK_KINDS)) for name in self.servos)
        assert waiting.verifications == sum(len(self.undone(name, (MessageKind.VERIFICATION,))) for name in self.servos)


Against.TestCase.settings = examples(25, stateful_step_count=25)
TestAgainst = pytest.mark.slow(Against.TestCase)
