"""Names of the servos of a twin, and which model each of them has; light to import, as the service needs no more.

In a file::

    [servos]
    "ax-1" = "axis"                 # one servo
    "line-*" = "axis"               # all names with this beginning; the first match counts
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property, lru_cache

from servotwin.config.table import Table, named
from servotwin.errors import InvalidInput
from servotwin.messages import NAME_PATTERN


@dataclass(frozen=True)
class ServoNames:
    """Servos and the names of their models.

    Parameters
    ----------
    servos : tuple of (str, str)
        (name of a servo, or a pattern with *, name of its model).

    Raises
    ------
    InvalidInput
        There is none, or a name is not allowed.
    """

    servos: tuple[tuple[str, str], ...]

    def __post_init__(self) -> None:
        if not self.servos:
            raise InvalidInput('servos: is empty; give at least one, such as "ax-1" = "NAME OF A MODEL"')
        for servo, _ in self.servos:
            if not re.match(NAME_PATTERN, servo.replace("*", "a")):
                raise InvalidInput(f"servos: {servo!r} is not allowed: 1 to 64 of A-Z a-z 0-9 . _ - and * for any")

    @classmethod
    def read(cls, table: Table) -> ServoNames:
        """Read [servos] of a twin's file."""
        servos = table.table("servos", required=True)
        with named(table):
            return cls(tuple((servo, servos.text(servo)) for servo in servos.values))

    def model_of(self, servo: str) -> str | None:
        """Return the name of a servo's model; None: it has none."""
        if not re.match(NAME_PATTERN, servo):
            return None
        exact = self._exact.get(servo)
        return exact or next((model for pattern, model in self._patterns if fnmatchcase(servo, pattern)), None)

    def test(self, most: int) -> Callable[[str], bool]:
        """Test whether there is a servo of a name; so many answers are kept, of invalid names, however long, none."""

        @lru_cache(maxsize=most)
        def has(servo: str) -> bool:
            return self.model_of(servo) is not None

        return lambda servo: re.match(NAME_PATTERN, servo) is not None and has(servo)

    @cached_property
    def _exact(self) -> dict[str, str]:
        return {servo: model for servo, model in self.servos if "*" not in servo}

    @cached_property
    def _patterns(self) -> tuple[tuple[str, str], ...]:
        return tuple((servo, model) for servo, model in self.servos if "*" in servo)
