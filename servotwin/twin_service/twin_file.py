"""A twin's file as a whole: [service] is read here, [servos] by `twin.servo_names`, [models] by `twin.model_registry`.

The models take long to import. The service leaves them to its workers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from servotwin.config.table import Table, parse_toml, read_inner, read_toml
from servotwin.errors import InvalidInput
from servotwin.twin.servo_names import ServoNames
from servotwin.twin_service.config import ServiceConfig, read_service
from servotwin.twin_service.worker import WorkerStart

if TYPE_CHECKING:
    from servotwin.twin.model_registry import ModelRegistry


@dataclass(frozen=True)
class TwinFile:
    """Parsed twin's file.

    Attributes
    ----------
    path : Path
    service : ServiceConfig
    servos : ServoNames
    text : str
        Of the file: workers read it once more.
    """

    path: Path
    service: ServiceConfig
    servos: ServoNames
    text: str

    @cached_property
    def fleet(self) -> ModelRegistry:
        """Models and servos, read at the first use; raises InvalidInput."""
        from servotwin.twin.model_registry import ModelRegistry

        return ModelRegistry.loads(self.text, str(self.path), self.path.parent)

    @property
    def service_table(self) -> Table:
        """Table [service] as it is in the file, to name its keys in errors."""
        return parse_toml(self.text, str(self.path)).table("service")

    @property
    def start(self) -> WorkerStart:
        """First message to a worker."""
        return WorkerStart(self.text, str(self.path), str(self.path.parent))


def read_twin(path: Path, models: bool = True) -> TwinFile:
    """Read a twin's file; where not `models`, without checking [models], which takes much longer.

    Raises
    ------
    InvalidInput
        One sentence that names the file, the key and what is allowed.
    """
    table = read_toml(path)
    text, folder = path.read_text(encoding="utf-8"), path.parent
    config = read_inner(table, "service", lambda inner: read_service(inner, folder))
    servos = ServoNames.read(table)
    table.known("models")
    table.done()
    twin = TwinFile(path, config, servos, text)
    if models:
        _ = twin.fleet
    return twin


def service_of(path: Path) -> ServiceConfig:
    """Read [service] alone, without the models, which take much longer."""
    table = read_toml(path)
    try:
        return read_inner(table, "service", lambda inner: read_service(inner, path.parent))
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be read ({error.strerror or error})") from None
