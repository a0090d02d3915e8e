"""What a machine's page says of the acts of engineers."""

from typing import Any

import msgspec
import pytest

from servotwin.dashboard.oversight import present_oversight
from servotwin.store.records import StoredEvidence

HOLD = {"act": "hold", "who": "eva", "why": "bearing", "time": 1.0}
BACK = {"act": "roll back", "who": "eva", "why": "it hums", "time": 2.0, "version": 3}


def shown(*bodies: dict[str, Any]) -> dict[str, Any]:
    return present_oversight(
        [
            StoredEvidence(at, "act", 0, msgspec.msgpack.encode(body), None, None, None, "", "", None, float(at))
            for at, body in enumerate(bodies)
        ]
    )


@pytest.mark.parametrize(
    ("after", "outcome"),
    [
        ((), "waits for the next window"),
        (({"act": BACK, "refused": "", "later": True},), "sent"),
        (({"act": BACK, "refused": "it swings", "later": True},), "not sent: it swings"),
        (({"act": HOLD, "refused": "", "later": False},), "ended by a later act"),
        (({"act": HOLD, "refused": "no", "later": False},), "waits for the next window"),
    ],
)
def test_a_roll_back_says_what_became_of_it(after: tuple[dict[str, Any], ...], outcome: str) -> None:
    found = shown({"act": BACK, "refused": "", "later": False}, *after)
    (back,) = [act for act in found["acts"] if act["act"] == "roll back"]
    assert back["outcome"] == outcome
    assert found["held"] is not None


def test_acts_of_an_earlier_version_are_done_or_refused() -> None:
    found = shown({"act": BACK, "refused": ""}, {"act": BACK, "refused": "not known"})
    assert [act["outcome"] for act in found["acts"]] == ["refused: not known", "done"]


def test_what_was_set_two_hundred_acts_ago_still_holds() -> None:
    many = [{"act": BACK | {"time": float(at)}, "refused": "no", "later": False} for at in range(300)]
    found = shown({"act": {**HOLD, "act": "ask first"}, "refused": "", "later": False}, *many)
    assert found["ask_first"]
    assert len(found["acts"]) == 200
