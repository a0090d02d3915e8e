"""Documents of the version before, rewritten as this version writes them.

There tolerance, gains ("controller" in messages) and band stood side by side; a verification was called "proof".
"""

from typing import Any

_SUCCESSORS = {"update/1": "update/2", "fallback/1": "fallback/2", "hello/1": "hello/2", "kept/1": "parameters/2"}
LEGACY_TAGS = frozenset(_SUCCESSORS)
MAX_LEGACY_BYTES = 65_536
"""Larger documents are not rewritten, as that decodes them without a schema; these messages take some hundred bytes."""


def upgrade(document: Any) -> Any:
    """Rewrite a decoded document of an earlier schema; any other is returned as it is."""
    if not isinstance(document, dict) or document.get("type") not in LEGACY_TAGS:
        return document
    rest = {**document, "type": _SUCCESSORS[document["type"]]}
    setting = {key: rest.pop(key) for key in ("tolerance", "gains", "band") if key in rest}
    if "controller" in rest:
        setting["gains"] = rest.pop("controller")
    if "proof" in rest:
        rest["verification"] = rest.pop("proof")
    return {**rest, "setting": setting}
