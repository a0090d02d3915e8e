"""A twin's file as a whole: [service] is read here, models and servos by `twin.model_registry`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from servotwin.config.table import read_inner, read_toml
from servotwin.errors import InvalidInput
from servotwin.twin.model_registry import ModelRegistry
from servotwin.twin_service.config import ServiceConfig, read_service
from servotwin.twin_service.worker import WorkerStart


@dataclass(frozen=True)
class TwinFile:
    """Parsed twin's file.

    Attributes
    ----------
    path : Path
    service : ServiceConfig
    fleet : ModelRegistry
    text : str
        Of the file: workers read it once more.
    """

    path: Path
    service: ServiceConfig
    fleet: ModelRegistry
    text: str

    @property
    def start(self) -> WorkerStart:
        """First message to a worker."""
        return WorkerStart(self.text, str(self.path), str(self.path.parent))


def read_twin(path: Path) -> TwinFile:
    """Read a twin's file.

    Raises
    ------
    InvalidInput
        One sentence that names the file, the key and what is allowed.
    """
    table = read_toml(path)
    text, folder = path.read_text(encoding="utf-8"), path.parent
    config = read_inner(table, "service", lambda inner: read_service(inner, folder))
    fleet = ModelRegistry.read(table, folder)
    table.done()
    return TwinFile(path, config, fleet, text)


def service_of(path: Path) -> ServiceConfig:
    """Read [service] alone, without the models, which take much longer."""
    table = read_toml(path)
    try:
        return read_inner(table, "service", lambda inner: read_service(inner, path.parent))
    except OSError as error:
        raise InvalidInput(f"{path}: cannot be read ({error.strerror or error})") from None
