"""Replay of a stored estimate, from the stored window, the expectation before it, model and settings."""

from __future__ import annotations

from typing import NamedTuple

import msgspec

from servotwin import messages
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate
from servotwin.messages import InvalidMessage, WindowMessage
from servotwin.twin.context import context_of, described, differences, parts_of
from servotwin.twin.estimating import DecodedWindow, estimator_of
from servotwin.twin.evidence_rows import StoredEstimate, plain
from servotwin.twin.model_registry import ServoModel


class ReplayResult(NamedTuple):
    """Result of a replay.

    Attributes
    ----------
    estimate : GapEstimate
        Of the repetition.
    same : bool
        True where it equals the stored one, bit for bit.
    differs : tuple of str
        Differences of the context, each with both values: versions, sources, processor and, under another model, its
        numbers and settings.
    changed : tuple of str
        Names of the values of the estimate that differ.
    """

    estimate: GapEstimate
    same: bool
    differs: tuple[str, ...]
    changed: tuple[str, ...]


_estimated = msgspec.msgpack.Decoder(StoredEstimate)


def replay(window: bytes, body: bytes, context: str, model: ServoModel | None = None) -> ReplayResult:
    """Repeat an estimate and compare it with the stored one.

    Parameters
    ----------
    window : bytes
        The message, decompressed.
    body : bytes
        Body of the estimate's evidence.
    context : str
        JSON of the context that the evidence names.
    model : ServoModel, optional
        Model to estimate with; None: model and settings of the stored estimate.

    Raises
    ------
    InvalidInput
        The window, the evidence or the context cannot be read.
    """
    message, stored, then = _window(window), _stored(body), parts_of(context)
    servo, settings = described(then) if model is None else (model.servo, model.settings)
    now = parts_of(context_of(servo, settings)[1])
    expected = stored.prior.expectation(settings.on(servo).trend)
    estimate = DecodedWindow.of(message).estimate(estimator_of(servo, settings), expected)
    again = plain(estimate)
    return ReplayResult(
        estimate, again == bytes(stored.estimate), differences(then, now), _changed(stored.estimate, again)
    )


def _window(data: bytes) -> WindowMessage:
    try:
        message = messages.decode(data)
    except InvalidMessage as error:
        raise InvalidInput(f"the stored window is not understood: {error}") from None
    if not isinstance(message, WindowMessage):
        raise InvalidInput(
            f"the stored message is a {type(message).__name__}, and only a window can be estimated again"
        )
    return message


def _stored(body: bytes) -> StoredEstimate:
    try:
        return _estimated.decode(body)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidInput(f"the stored estimate is not understood: {error}") from None


def _changed(then: bytes, now: bytes) -> tuple[str, ...]:
    """Names of the values that differ in any bit."""
    one, other = (msgspec.msgpack.decode(each, type=dict[str, msgspec.Raw]) for each in (then, now))
    keys = sorted({*one, *other})
    return tuple(key for key in keys if bytes(one.get(key, b"")) != bytes(other.get(key, b"")))
