"""Settings looked up in a table; each is verified afterwards for the exact evidence, and withdrawn where that fails.

An optional part, pure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
from msgspec import Struct

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import MachineReading
from servotwin.estimation.learning.motor import LearntMotor
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.messages import Setting, Update
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.certified.lookup import TablePolicy
from servotwin.redesign.certified.uncertainty import Region
from servotwin.redesign.design import Design, decoded_part
from servotwin.redesign.policy import Evidence, Redesign


class VerificationRequest(Struct, frozen=True, omit_defaults=True, tag="verification-request/1"):
    """A verification that a twin schedules for itself through the service's queue.

    Attributes
    ----------
    servo : str
    version : int
        Of the update as it was issued.
    window : (str, int)
        Boot and sequence of the window from which the update was computed.
    region : Region
        Range that the setting must serve.
    setting : Design
        The controller that was looked up.
    machine : MachineReading, optional
        The machine's numbers as learnt by then; None: the model's, within the stated half-widths.
    motor : LearntMotor, optional
        The motor's.
    """

    servo: str
    version: int
    window: tuple[str, int]
    region: Region
    setting: Design
    machine: MachineReading | None = None
    motor: LearntMotor | None = None

    @classmethod
    def of(cls, update: Update, redesign: Redesign, evidence: Evidence) -> VerificationRequest | None:
        """Make the verification that an update still needs; None: none."""
        if redesign.to_verify is None:
            return None
        assert redesign.certificate is not None
        return cls(
            update.servo,
            update.version,
            update.window,
            redesign.to_verify,
            redesign.certificate.setting,
            None if evidence.machine is None else evidence.machine.reading,
            evidence.motor,
        )


class LookupState(Struct, frozen=True):
    """Part of the twin's state that belongs to settings looked up.

    Attributes
    ----------
    why : str
        Reason for which the fallback set is sent next; empty: nothing is withdrawn.
    misled : bool
        True once a verification has failed: from then on every setting is verified before it is sent.
    """

    why: str = ""
    misled: bool = False


@dataclass(frozen=True)
class Lookups:
    """Policy that looks settings up, with the memory of failed verifications.

    Parameters
    ----------
    policy : TablePolicy
    """

    policy: TablePolicy

    def redesign(self, state: LookupState, evidence: Evidence) -> tuple[LookupState, Redesign]:
        """Look a setting up; after a failed verification return the fallback set once, and nothing from the table."""
        if state.why:
            redesign = self.policy.withdrawn(evidence, state.why)
            return (state if redesign.setting is None else LookupState(misled=True)), redesign
        return state, (self.policy.policy if state.misled else self.policy).redesign(evidence)

    def verify(
        self, state: LookupState, request: VerificationRequest, current: Sequence[Setting | None]
    ) -> tuple[LookupState, Certificate | NotVerified, str]:
        """Verify a setting for the evidence that it was sent on.

        Parameters
        ----------
        state : LookupState
        request : VerificationRequest
        current : sequence of Setting or None
            In force, or pending; a setting that is neither is not verified any more.

        Returns
        -------
        LookupState, Certificate or NotVerified, str
            The last one is the reason for which the setting is withdrawn; empty: it is not.
        """
        sent = request.setting.setting()
        if not any(setting is not None and sent.same_loop(setting) for setting in current):
            return state, NotVerified("not verified: another setting is in force by now"), ""
        machine = None if request.machine is None else FactorPrior.of_reading(request.machine)
        result = self.policy.policy.confirm(request.region, request.setting, machine, request.motor)
        if not isinstance(result, NotVerified):
            return state, result, ""
        why = f"the verification of version {request.version} failed: {result.reason}"
        return LookupState(why, misled=True), result, why


def encode_request(request: VerificationRequest) -> bytes:
    """Encode a request for the queue."""
    return _encoder.encode(request)


def decode_request(data: bytes) -> VerificationRequest:
    """Decode a request from the queue; the version before called it "proof/1".

    Raises
    ------
    InvalidInput
        The bytes are not a request.
    """
    try:
        document = msgspec.msgpack.decode(data)
        if isinstance(document, dict) and document.get("type") == "proof/1":
            document["type"] = VerificationRequest.__struct_config__.tag
        return msgspec.convert(document, VerificationRequest, dec_hook=decoded_part)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidInput(f"the verification request is not understood: {error}") from None


_encoder = msgspec.msgpack.Encoder()
