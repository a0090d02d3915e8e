"""What becomes of looked-up settings: each is proved for the exact evidence later, and withdrawn where that fails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import msgspec
from msgspec import Struct

from servotwin.errors import InvalidInput
from servotwin.messages import Setting, Update
from servotwin.redesign.certified.certificate import NotVerified
from servotwin.redesign.certified.lookup import TablePolicy
from servotwin.redesign.certified.uncertainty import Region
from servotwin.redesign.design import Design
from servotwin.redesign.evidence import Evidence
from servotwin.redesign.policy import Redesign

if TYPE_CHECKING:
    from servotwin.twin.store import Store


class Question(Struct, frozen=True, tag="proof/1"):
    """A proof that a twin asks itself for.

    Attributes
    ----------
    servo : str
    version : int
        Of the update as it was issued.
    window : (str, int)
        Boot and sequence of the one that it stands on.
    region : Region
        What the setting is to hold for.
    setting : Design
    """

    servo: str
    version: int
    window: tuple[str, int]
    region: Region
    setting: Design


class Memory(Struct, frozen=True):
    """What proofs have shown of the table, for one servo: a part of the twin's state.

    Attributes
    ----------
    why : str
        Why the fallback set goes out next; empty: nothing is withdrawn.
    misled : bool
        Whether a proof has failed: then nothing is looked up any more, and everything proved before it is sent.
    """

    why: str = ""
    misled: bool = False


class Lookups:
    """The policy with a table, of one servo.

    Parameters
    ----------
    policy : TablePolicy

    Attributes
    ----------
    memory : Memory
    """

    needs_estimate: ClassVar[bool] = False

    def __init__(self, policy: TablePolicy) -> None:
        self.policy, self.memory = policy, Memory()

    def redesign(self, evidence: Evidence) -> Redesign:
        """A setting of the table; the fallback set once after a proof has failed, and proved settings from then on."""
        if self.memory.why:
            sent = self.policy.withdrawn(evidence, self.memory.why)
            if sent.setting is not None:
                self.memory = Memory(misled=True)
            return sent
        return (self.policy.policy if self.memory.misled else self.policy).redesign(evidence)

    def settle(self, question: Question, running: Sequence[Setting | None], store: Store) -> str:
        """Prove a setting for the evidence that it was sent on; why it is withdrawn, empty where it is not.

        Parameters
        ----------
        question : Question
        running : sequence of Setting or None
            What is in force, or on its way: another setting is neither proved any more nor withdrawn.
        store : Store
        """
        wanted = question.setting.setting()
        if not any(one is not None and wanted.same_loop(one) for one in running):
            store.add_proof(question, NotVerified("not proved: another setting is in force by now"))
            return ""
        found = self.policy.policy.confirm(question.region, question.setting)
        store.add_proof(question, found)
        if not isinstance(found, NotVerified):
            return ""
        why = f"the proof of version {question.version} failed: {found.reason}"
        self.memory = Memory(why, misled=True)
        store.add_withdrawn(question, why)
        return why


def question_of(update: Update, redesign: Redesign) -> Question:
    """What is to be proved of an update that was made of a redesign with a proof owed."""
    assert redesign.to_verify is not None
    assert redesign.certificate is not None
    return Question(update.servo, update.version, update.window, redesign.to_verify, redesign.certificate.setting)


def encode_question(question: Question) -> bytes:
    """Its bytes, for the queue."""
    return _encoder.encode(question)


def decode_question(data: bytes) -> Question:
    """The question in these bytes.

    Raises
    ------
    InvalidInput
        They hold none.
    """
    try:
        return _decoder.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidInput(f"the proof that is asked for is not understood: {error}") from None


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Question)
