"""The last parameters that were proved at the machine: kept, so that a restart does not begin at the beginning."""

import os
from pathlib import Path
from typing import Protocol

import msgspec
from msgspec import Struct

from servotwin.edge.parameters import Parameters
from servotwin.errors import InvalidInput
from servotwin.messages import Band, Gains
from servotwin.runtime.files import replace_file


class Store(Protocol):
    """Keeps one set of parameters."""

    def save(self, parameters: Parameters) -> None:
        """Keep these instead of what was kept; return when they are safe."""

    def load(self) -> Parameters | None:
        """What is kept, as parameters of a new boot; None: nothing was ever kept."""


class Kept(Struct, frozen=True, tag="kept/1"):
    """What outlives a boot; sample times do not."""

    version: int
    tolerance: float
    gains: Gains | None
    band: Band | None
    fallback: bool


def kept(parameters: Parameters) -> Kept:
    """The part that outlives a boot."""
    p = parameters
    return Kept(p.version, p.tolerance, p.gains, p.band, p.fallback)


def restored(saved: Kept) -> Parameters:
    """As parameters that stand on no data of this boot."""
    return Parameters(saved.version, saved.tolerance, gains=saved.gains, band=saved.band, fallback=saved.fallback)


class MemoryStore:
    """In memory, for simulation and tests."""

    def __init__(self) -> None:
        self._kept: Kept | None = None

    def save(self, parameters: Parameters) -> None:
        """Keep these."""
        self._kept = kept(parameters)

    def load(self) -> Parameters | None:
        """What is kept."""
        return None if self._kept is None else restored(self._kept)


class FileStore:
    """In one file, replaced as a whole: a crash leaves the old one or the new one.

    Parameters
    ----------
    path : path
        Its folder exists; a neighbour with `.new` at its name's end is used for writing.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path)

    def save(self, parameters: Parameters) -> None:
        """Replace the file; return when the disk has it. Raises OSError."""
        replace_file(self._path, msgspec.json.encode(kept(parameters)), durable=True)

    def load(self) -> Parameters | None:
        """What the file holds.

        Raises
        ------
        InvalidInput
            There is a file and it does not hold parameters.
        """
        try:
            data = self._path.read_bytes()
        except FileNotFoundError:
            return None
        try:
            return restored(msgspec.json.decode(data, type=Kept))
        except (msgspec.MsgspecError, ValueError) as error:
            raise InvalidInput(f"{self._path}: does not hold the edge's last parameters: {error}") from None
