"""The last parameters that the loop kept its band under: stored, so that a restart goes on from them."""

import os
from pathlib import Path
from typing import Protocol

import msgspec
from msgspec import Struct

from servotwin.edge.parameters import Parameters
from servotwin.errors import InvalidInput
from servotwin.messages import Setting
from servotwin.messages.legacy import upgrade
from servotwin.runtime.files import replace_file


class ParameterStore(Protocol):
    """Stores one set of parameters."""

    def save(self, parameters: Parameters) -> None:
        """Replace the stored parameters; return when the new ones are safe."""

    def load(self) -> Parameters | None:
        """The stored parameters, as those of a new boot; None: nothing was ever stored."""


class StoredParameters(Struct, frozen=True, tag="parameters/2"):
    """The part of the parameters that outlives a boot; sample times do not."""

    version: int
    setting: Setting
    fallback: bool

    @classmethod
    def of(cls, parameters: Parameters) -> "StoredParameters":
        """The part of these parameters that outlives a boot."""
        return cls(parameters.version, parameters.setting, parameters.fallback)

    def parameters(self) -> Parameters:
        """The same as parameters that stand on no data of this boot."""
        return Parameters(self.version, self.setting, fallback=self.fallback)


class MemoryParameterStore:
    """In memory, for simulation and tests."""

    def __init__(self) -> None:
        self._stored: StoredParameters | None = None

    def save(self, parameters: Parameters) -> None:
        """Replace the stored parameters."""
        self._stored = StoredParameters.of(parameters)

    def load(self) -> Parameters | None:
        """The stored parameters."""
        return None if self._stored is None else self._stored.parameters()


class FileParameterStore:
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
        replace_file(self._path, msgspec.json.encode(StoredParameters.of(parameters)), durable=True)

    def load(self) -> Parameters | None:
        """The parameters in the file, in this version's form or the one before.

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
            return msgspec.convert(upgrade(msgspec.json.decode(data)), StoredParameters).parameters()
        except (msgspec.MsgspecError, ValueError) as error:
            raise InvalidInput(f"{self._path}: does not hold the edge's last parameters: {error}") from None
