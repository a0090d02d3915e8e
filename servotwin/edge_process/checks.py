"""What an edge's file names and does not hold: looked at before anything runs, in the control process, at no cost."""

from __future__ import annotations

from importlib.util import find_spec

from servotwin.edge_process.config import EdgeConfig, TwinLink, password_of, token_of
from servotwin.errors import InvalidInput
from servotwin.link.url import is_encrypted


def check(config: EdgeConfig) -> None:
    """Refuse what could never work; what may come back, a twin or a disk that is full, is none of it.

    Raises
    ------
    InvalidInput
        The token, the broker's password, the certificates or a library of the link are not there, or a folder is not.
    """
    _check_folders(config)
    if config.twin is not None:
        token_of(config.twin, config.folder)
        password_of(config.twin, config.folder)
        _check_link(config, config.twin)


def _check_folders(config: EdgeConfig) -> None:
    for key in ("outbox", "parameters", "status", "boots"):
        name = getattr(config.keeping, key)
        folder = config.path(name).parent
        if not folder.is_dir():
            raise InvalidInput(f"{config.source}: [keep]: {key} = {name!r}: there is no folder {folder}")


def _check_link(config: EdgeConfig, twin: TwinLink) -> None:
    if twin.over_mqtt and find_spec("paho") is None:
        raise InvalidInput(
            f"{config.source}: [twin]: url = {twin.url!r} needs paho-mqtt: pip install 'servotwin[mqtt]'"
        )
    if twin.ca_file is None or not is_encrypted(twin.url):
        return
    import ssl

    path = config.path(twin.ca_file)
    try:
        ssl.create_default_context(cafile=str(path))
    except OSError as error:
        raise InvalidInput(f"{path}: holds no certificates that can be read ({error.strerror or error})") from None
