"""Store of the last parameters under which the loop kept its band: a restart goes on from them."""

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
        """Replace the stored parameters; return when the new ones are stored safely."""

    def load(self) -> Parameters | None:
        """Return the stored parameters, as those of a new boot; None: nothing was ever stored."""


class StoredParameters(Struct, frozen=True, tag="parameters/2"):
    """The part of the parameters that outlives a boot; sample times do not."""

    version: int
    setting: Setting
    fallback: bool

    @classmethod
    def of(cls, parameters: Parameters) -> "StoredParameters":
        """Take the part of parameters that outlives a boot."""
        return cls(parameters.version, parameters.setting, parameters.fallback)

    def parameters(self) -> Parameters:
        """Make parameters for a new boot, computed from no data of it."""
        return Parameters(self.version, self.setting, fallback=self.fallback)


class FileParameterStore:
    """A parameter store in one file, replaced as a whole: a crash leaves the old file or the new one.

    Parameters
    ----------
    path : path
        Its folder exists; a neighbour NAME.new is used for writing.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path)

    def save(self, parameters: Parameters) -> None:
        """Replace the file; return when it is on the disk. Raises OSError."""
        replace_file(self._path, msgspec.json.encode(StoredParameters.of(parameters)), durable=True, mode=0o600)

    def load(self) -> Parameters | None:
        """Return the parameters in the file, in the form of this version or of the one before; None: there is no file.

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
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise InvalidInput(f"{self._path}: does not hold the edge's last parameters: {error}") from None
