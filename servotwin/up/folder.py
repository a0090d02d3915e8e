"""Folder of `servotwin up`: created atomically, locked by one process, resumed at the next start."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from servotwin.drives.simulated.machine_state import MachineState, read_state
from servotwin.edge_process.config_file import edge_toml, load
from servotwin.errors import InvalidInput
from servotwin.runtime.files import write_text
from servotwin.runtime.locks import locked
from servotwin.runtime.retry import Retry
from servotwin.twin_service.auth import Verifiers, write_tokens
from servotwin.up import enrolment
from servotwin.up.plan import PRE_TRIGGER_S, RATE, SERVOS, WINDOW_S, ServoPlan, machine_toml, twin_toml
from servotwin.up.speed import FASTEST

MARKER, LOCK, TWIN, OPERATOR = "servotwin-up.json", "lock", "twin.toml", "operator.token"
EDGE, MACHINE, DRIVE = "edge.toml", "machine.toml", "drive.sock"
LONGEST = 100
"""Bytes of a socket's path that every system accepts: Linux allows 107, macOS 103."""
_ENDING_S = 25.0
"""s that processes of an earlier start, which was killed, may take to end."""
_PLACEHOLDER = "http://127.0.0.1:1"
"""URL of the twin in the edges' files until its port is known."""
_RETRY = Retry(0.5, 2.0, 2.0)


class _Marker(msgspec.Struct, frozen=True, tag="servotwin-up/1", tag_field="schema"):
    """Marks a folder as made by `servotwin up`; names of its servos."""

    servos: list[str]


@dataclass(frozen=True)
class Folder:
    """A complete, locked folder.

    Attributes
    ----------
    path : Path
        Absolute.
    lock : int
        Descriptor of the lock, which every process that works in the folder keeps open.
    new : bool
        True: it was made by this start.
    """

    path: Path
    lock: int
    new: bool

    def servo(self, servo: ServoPlan) -> Path:
        """Folder of a servo."""
        return self.path / servo.name

    def machine(self, servo: ServoPlan) -> MachineState | None:
        """Last state of a machine; None: it is new."""
        return read_state(self.servo(servo) / "state.json")

    def connect(self, servo: ServoPlan, url: str) -> None:
        """Write the twin's URL to the file of a servo's edge."""
        file = self.servo(servo) / EDGE
        config = load(file)
        if config.twin is not None and config.twin.url != url:
            write_text(file, edge_toml(replace(config, twin=replace(config.twin, url=url))))

    @property
    def operator_file(self) -> Path:
        """File with the operator's token."""
        return self.path / OPERATOR

    def operator(self) -> str:
        """Operator's token."""
        return self.operator_file.read_text(encoding="utf-8").strip()


@contextmanager
def opened(path: Path, making: Callable[[Path], None] | None = None) -> Iterator[Folder]:
    """Open the folder, made at the first start, and lock it for this process.

    Parameters
    ----------
    path : Path
    making : callable, optional
        Called with the folder before it is made, which takes minutes where code has to be compiled first.

    Raises
    ------
    InvalidInput
        It holds something else, is in use, or cannot be written.
    """
    path = path.absolute()
    _check_length(path)
    try:
        new = not path.exists() or not any(path.iterdir())
        if new:
            if making is not None:
                making(path)
            _make(path)
        _check(path)
        with _locked(path) as lock:
            yield Folder(path, lock, new)
    except OSError as error:
        raise InvalidInput(f"{error.filename or path}: {(error.strerror or str(error)).lower()}") from None


def _check_length(path: Path) -> None:
    longest = max(len(os.fsencode(path / servo.name / DRIVE)) for servo in SERVOS)
    if longest > LONGEST:
        fault = f"its path is {longest - LONGEST} bytes too long for the sockets in it"
        raise InvalidInput(f"folder {path}: {fault}; choose a shorter one with --folder")


def _check(path: Path) -> None:
    try:
        servos = msgspec.json.decode((path / MARKER).read_bytes(), type=_Marker).servos
    except (OSError, msgspec.MsgspecError):
        allowed = "choose another with --folder, or one that is empty or not there yet"
        raise InvalidInput(f"folder {path}: was not made by servotwin up; {allowed}") from None
    needed = [TWIN, OPERATOR, *(f"{name}/{file}" for name in servos for file in (EDGE, MACHINE, enrolment.TOKEN))]
    missing = [name for name in needed if not (path / name).is_file()]
    if servos != [servo.name for servo in SERVOS] or missing:
        fault = f"{missing[0]} is missing" if missing else f"its servos are {', '.join(servos)}"
        raise InvalidInput(f"folder {path}: {fault}; remove the folder to begin anew, or choose another with --folder")


def _make(path: Path) -> None:
    """Make everything in a temporary folder beside it, then rename that one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    try:
        _fill(temporary)
        with suppress(FileExistsError):  # another start was quicker
            temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _fill(path: Path) -> None:
    write_tokens(path / "tokens.toml", Verifiers())
    write_text(path / TWIN, twin_toml(SERVOS, FASTEST))
    enrolment.enroll_operator(path / TWIN, "up", path / OPERATOR)
    for servo in SERVOS:
        folder, drive = path / servo.name, {"kind": "simulated", "address": f"unix:{DRIVE}"}
        request = enrolment.Enrolment(
            servo=servo.name,
            folder=folder,
            role=servo.role,
            sample_rate=RATE,
            drive=drive,
            url=_PLACEHOLDER,
            noise=enrolment.StatedNoise(1e3 * servo.noise_mm),
        )
        enrolment.enroll(path / TWIN, request)
        config = load(folder / EDGE)
        agent = replace(config.agent, retry=_RETRY, window_s=WINDOW_S, pre_trigger_s=PRE_TRIGGER_S)
        link = None if config.twin is None else replace(config.twin, live=True)
        write_text(folder / EDGE, edge_toml(replace(config, agent=agent, twin=link)))
        write_text(folder / MACHINE, machine_toml(servo))
    write_text(path / MARKER, msgspec.json.encode(_Marker([servo.name for servo in SERVOS])).decode() + "\n")


@contextmanager
def _locked(path: Path) -> Iterator[int]:
    """Take the lock. Processes that a killed start left behind hold it until they end, which they do by themselves."""
    end = time.monotonic() + _ENDING_S
    with ExitStack() as stack:
        while True:
            try:
                descriptor = stack.enter_context(locked(path / LOCK))
                break
            except BlockingIOError:
                holder = (path / LOCK).read_bytes()[:32].decode("ascii", "replace").strip()
                # The holder's id is in the file; its children inherit the lock and may outlive it.
                if _alive(holder) or time.monotonic() > end:
                    raise InvalidInput(
                        f"folder {path}: is in use by another servotwin up (process {holder or 'unknown'})"
                    ) from None
                time.sleep(0.1)
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        yield descriptor
        os.ftruncate(descriptor, 0)


def _alive(holder: str) -> bool:
    if not holder.isdecimal():
        return True
    try:
        os.kill(int(holder), 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
