"""The file of tokens: what the service keeps of each, a digest that shows nothing of the token itself."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from servotwin.config.table import Table, read_toml
from servotwin.errors import InvalidInput
from servotwin.messages import NAME_PATTERN
from servotwin.twin_service.secret_file import check_private, write_private

_HEAD = "# Digests of tokens, as precious as the tokens themselves: for the service's own eyes.\n"
VERIFIER = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Verifiers:
    """Who may speak to the service.

    Attributes
    ----------
    servos, operators : mapping of str to bytes
        Name to `link.seal.verifier_of` its token.
    """

    servos: Mapping[str, bytes] = field(default_factory=dict)
    operators: Mapping[str, bytes] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Verifiers({len(self.servos)} servos, {len(self.operators)} operators)"


def read_tokens(path: Path) -> Verifiers:
    """The verifiers in a file of mode 0600.

    Raises
    ------
    InvalidInput
        It cannot be read, is readable by others, or something in it is no name or no verifier; what it holds instead
        is not shown.
    """
    if not path.exists():
        raise InvalidInput(f"{path}: there is no such file of tokens; `servotwin enroll` makes it")
    check_private(path)
    if not path.read_bytes().strip():
        return Verifiers()
    table = read_toml(path)
    found = Verifiers(_verifiers(table.table("servos")), _verifiers(table.table("operators")))
    table.done()
    _no_token_twice(path, found)
    return found


def write_tokens(path: Path, verifiers: Verifiers) -> None:
    """Replace the file as a whole, mode 0600; InvalidInput where that is impossible."""
    parts = [_written("servos", verifiers.servos), _written("operators", verifiers.operators)]
    write_private(path, _HEAD + "\n".join(parts))


def _written(name: str, verifiers: Mapping[str, bytes]) -> str:
    lines = [f'"{key}" = "{value.hex()}"\n' for key, value in sorted(verifiers.items())]
    return f"[{name}]\n" + "".join(lines)


def _verifiers(table: Table) -> dict[str, bytes]:
    return {name: _verifier(table, name) for name in table.values}


def _verifier(table: Table, name: str) -> bytes:
    if re.fullmatch(NAME_PATTERN, name) is None:
        raise InvalidInput(
            f"{table.source}: [{table.name}] has an entry {name[:80]!r}: a name has 1 to 64 letters, digits, . _ or -"
        )
    value = table.values[name]
    if not isinstance(value, str) or VERIFIER.fullmatch(value) is None:
        raise InvalidInput(
            f"{table.source}: {table.path(name)} is no verifier: `servotwin enroll` writes 64 hex digits"
        )
    return bytes.fromhex(value)


def _no_token_twice(path: Path, found: Verifiers) -> None:
    owner: dict[bytes, str] = {}
    for name, verifier in [*found.servos.items(), *found.operators.items()]:
        if verifier in owner:
            raise InvalidInput(f"{path}: {owner[verifier]!r} and {name!r} have the same token")
        owner[verifier] = name
