"""Start of an edge: checks of its files, locks, the name of the boot, and the parameters of the last one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from servotwin.config.own_units import VOLTS_METRES, OwnUnits
from servotwin.control.gains import holds
from servotwin.edge.parameters import Parameters
from servotwin.edge.settings import AgentSettings
from servotwin.edge.store import FileParameterStore
from servotwin.edge.supervisor import Rules
from servotwin.edge_process.config import EdgeConfig, check_certificates, password_of, token_of
from servotwin.edge_process.monitoring import log, read_status
from servotwin.errors import InvalidInput
from servotwin.link.sqlite_file import check_kind
from servotwin.runtime.extras import check_extra
from servotwin.runtime.files import replace_file
from servotwin.runtime.locks import locked


def check(config: EdgeConfig) -> None:
    """Check a configuration for faults that do not pass; a twin out of reach or a full disk is none.

    Raises
    ------
    InvalidInput
        The token, the broker's password, the certificates, a library of the link or a folder is missing.
    """
    _check_files(config)
    token_of(config)
    password_of(config)
    check_certificates(config)
    if config.twin is not None and config.twin.over_mqtt:
        check_extra("paho", f"{config.source}: [twin]: url = {config.twin.url!r}")


def _check_files(config: EdgeConfig) -> None:
    """Check that each file can be written in its place, and is no other file of the edge."""
    twin = config.twin
    others = {} if twin is None else {"token_file": twin.token_file, "password_file": twin.password_file}
    taken = {config.path(name).resolve(): key for key, name in others.items() if name is not None}
    taken[Path(config.source).resolve()] = "this file itself"
    for key in ("outbox", "parameters", "status", "boots"):
        name = getattr(config.files, key)
        path, where = config.path(name), f"{config.source}: [keep]: {key} = {name!r}"
        try:
            if not path.parent.is_dir():
                raise InvalidInput(f"{where}: there is no folder {path.parent}")
            if path.is_dir():
                raise InvalidInput(f"{where}: is a folder; give the name of a file")
            if path.exists() and not path.is_file():  # a pipe, for one, would be waited for without an end
                raise InvalidInput(f"{where}: is no file; give the name of a file")
        except OSError as error:
            raise InvalidInput(f"{where}: cannot be used ({error.strerror})") from None
        if (other := taken.setdefault(path.resolve(), key)) != key:
            raise InvalidInput(f"{where}: is {other}; give another name")
    check_kind(config.path(config.files.outbox))


@contextmanager
def exclusive(config: EdgeConfig) -> Iterator[None]:
    """Lock an edge's files for this process: two edges would give one machine two voltages.

    The edge runs without a lock where the file system has none.

    Raises
    ------
    InvalidInput
        Another process holds a lock.
    """
    with ExitStack() as locks:
        for name in dict.fromkeys((config.files.parameters, config.files.outbox)):
            try:
                locks.enter_context(locked(config.path(f"{name}-lock")))
            except BlockingIOError:
                raise InvalidInput(f"{config.source}: another edge runs on its files; end that one first") from None
            except OSError as error:
                log("not locked", error=str(error))
        yield


def next_boot(path: Path, random: bytes) -> str:
    """Name this start by its number, and by random bytes that make it unique where an earlier one was not counted.

    Parameters
    ----------
    path : path
        File with the number of starts; it need not be readable.
    random : bytes
        8 bytes.
    """
    return f"b{_count(path) + 1}-{random.hex()}"


def count_start(path: Path, boot: str) -> None:
    """Count the start of this name, once its outbox is on the disk: from then on a missing outbox is a loss.

    Counted before, a start that is killed before it has an outbox would look as if it had lost one.
    """
    number = int(boot.partition("-")[0].removeprefix("b"))
    if _count(path) < number:
        with suppress(OSError):
            replace_file(path, f"{number}\n".encode("ascii"), durable=True, mode=0o600)


def is_later_start(boot: str) -> bool:
    """True where a start before the one of this name was counted."""
    return not boot.startswith("b1-")


def _count(path: Path) -> int:
    try:
        text = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return 0
    return int(text) if text.isdigit() and len(text) < 16 else 0


def stored_parameters(path: Path, version: int = 0) -> Parameters | None:
    """Load the parameters of an earlier start; a file that holds none is renamed, so that the machine can run.

    Parameters
    ----------
    path : path
    version : int
        In force by the last status; a missing file is said where it is not 0.
    """
    try:
        stored = FileParameterStore(path).load()
        if stored is None and version > 0:
            log("last parameters missing", version=version)
        return stored
    except InvalidInput as error:
        log("last parameters not readable", error=str(error))
    except OSError as error:
        log("last parameters not readable", error=str(error))
        return None
    try:
        path.replace(path.with_name(f"{path.name}.broken"))
    except OSError as error:
        log("last parameters not put aside", error=str(error))
    return None


def last_version(config: EdgeConfig) -> int:
    """Version in force by this servo's last status; 0: the configured parameters, or not known."""
    status = read_status(config.path(config.files.status)) or {}
    version = status.get("version") if status.get("servo") == config.agent.servo else 0
    return version if isinstance(version, int) else 0


def permitted(stored: Parameters | None, agent: AgentSettings, units: OwnUnits = VOLTS_METRES) -> Parameters | None:
    """Return the parameters of an earlier start where today's limits and law allow an update to them; else None."""
    if stored is None:
        return None
    centre, gains = Rules(agent.limits, agent.controller, agent.own).centre, stored.setting.gains
    good = gains is None or (centre is not None and agent.limits.allows_gains(gains, centre))
    allowed = stored.fallback or (good and agent.limits.allows_tolerance(stored.setting.tolerance))
    if allowed and (agent.controller is None or holds(agent.controller, gains)):
        return stored
    tolerance = {units.key("tolerance_m"): stored.setting.tolerance}
    log("last parameters not allowed any more", version=stored.version, **tolerance)
    return None
