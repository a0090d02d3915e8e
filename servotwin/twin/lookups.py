"""Settings looked up in a table: each is verified for the exact evidence later, and withdrawn where that fails.

An optional part, pure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
from msgspec import Struct

from servotwin.errors import InvalidInput
from servotwin.messages import Setting, Update
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.certified.lookup import TablePolicy
from servotwin.redesign.certified.uncertainty import Region
from servotwin.redesign.design import Design
from servotwin.redesign.policy import Evidence, Redesign


class VerificationRequest(Struct, frozen=True, tag="proof/1"):
    """A verification that a twin requests of itself, through the service's queue.

    Attributes
    ----------
    servo : str
    version : int
        Of the update as it was issued.
    window : (str, int)
        Boot and sequence of the one that it stands on.
    region : Region
        Range that the setting must serve.
    setting : Design
        The controller that was looked up.
    """

    servo: str
    version: int
    window: tuple[str, int]
    region: Region
    setting: Design

    @classmethod
    def of(cls, update: Update, redesign: Redesign) -> VerificationRequest | None:
        """The verification that an update still needs; None: none."""
        if redesign.to_verify is None:
            return None
        assert redesign.certificate is not None
        return cls(update.servo, update.version, update.window, redesign.to_verify, redesign.certificate.setting)


class LookupState(Struct, frozen=True):
    """Slice of the twin's state.

    Attributes
    ----------
    why : str
        Why the fallback set goes out next; empty: nothing is withdrawn.
    misled : bool
        True once a verification has failed: then nothing is looked up any more, and every setting is verified before it
        is sent.
    """

    why: str = ""
    misled: bool = False


@dataclass(frozen=True)
class Lookups:
    """The table's policy with the memory of what failed.

    Parameters
    ----------
    policy : TablePolicy
    """

    policy: TablePolicy

    def redesign(self, state: LookupState, evidence: Evidence) -> tuple[LookupState, Redesign]:
        """A setting of the table; the fallback set once after a verification has failed, and none of the table then."""
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
            In force, or pending: another setting is neither verified any more nor withdrawn.

        Returns
        -------
        LookupState, Certificate or NotVerified, str
            The last: why the setting is withdrawn; empty where it is not.
        """
        sent = request.setting.setting()
        if not any(setting is not None and sent.same_loop(setting) for setting in current):
            return state, NotVerified("not verified: another setting is in force by now"), ""
        result = self.policy.policy.confirm(request.region, request.setting)
        if not isinstance(result, NotVerified):
            return state, result, ""
        why = f"the verification of version {request.version} failed: {result.reason}"
        return LookupState(why, misled=True), result, why


def encode_request(request: VerificationRequest) -> bytes:
    """Encode a request for the queue."""
    return _encoder.encode(request)


def decode_request(data: bytes) -> VerificationRequest:
    """Decode a request from the queue.

    Raises
    ------
    InvalidInput
        The bytes hold none.
    """
    try:
        return _decoder.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidInput(f"the verification request is not understood: {error}") from None


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(VerificationRequest)
