"""Folder of `servotwin up`: created atomically, locked by one process, resumed at the next start."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
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
"""Bytes of a socket's path that every system takes."""
ENDING_S = 25.0
"""s that what an earlier start left behind may take to end."""
_PLACEHOLDER = "http://127.0.0.1:1"
_RETRY = Retry(0.5, 2.0, 2.0)


class Marker(msgspec.Struct, frozen=True, tag="servotwin-up/1", tag_field="schema"):
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

    def operator(self) -> str:
        """Operator's token."""
        return (self.path / OPERATOR).read_text(encoding="utf-8").strip()


@contextmanager
def opened(path: Path) -> Iterator[Folder]:
    """Open the folder, made at the first start, and lock it for this process.

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
            _make(path)
        _check(path)
        with _locked(path) as lock:
            yield Folder(path, lock, new)
    except OSError as error:
        raise InvalidInput(f"{error.filename or path}: {(error.strerror or str(error)).lower()}") from None


def _check_length(path: Path) -> None:
    longest = max(len(os.fsencode(path / servo.name / DRIVE)) for servo in SERVOS)
    if longest > LONGEST:
        told = f"its path is {longest - LONGEST} bytes too long for the sockets in it"
        raise InvalidInput(f"folder {path}: {told}; choose a shorter one with --folder")


def _check(path: Path) -> None:
    try:
        found = msgspec.json.decode((path / MARKER).read_bytes(), type=Marker).servos
    except (OSError, msgspec.MsgspecError):
        allowed = "choose another with --folder, or one that is empty or not there yet"
        raise InvalidInput(f"folder {path}: was not made by servotwin up; {allowed}") from None
    needed = [TWIN, OPERATOR, *(f"{name}/{file}" for name in found for file in (EDGE, MACHINE, enrolment.TOKEN))]
    missing = [name for name in needed if not (path / name).is_file()]
    if found != [servo.name for servo in SERVOS] or missing:
        what = f"{missing[0]} is missing" if missing else f"its servos are {', '.join(found)}"
        raise InvalidInput(f"folder {path}: {what}; remove the folder to begin anew, or choose another with --folder")


def _make(path: Path) -> None:
    """Make everything in a folder beside it, then rename that."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    try:
        _fill(beside)
        with suppress(FileExistsError):  # another start was quicker
            beside.replace(path)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _fill(path: Path) -> None:
    write_tokens(path / "tokens.toml", Verifiers())
    write_text(path / TWIN, twin_toml(SERVOS, FASTEST))
    enrolment.enroll_operator(path / TWIN, "up", path / OPERATOR)
    for servo in SERVOS:
        folder, drive = path / servo.name, {"kind": "simulated", "address": f"unix:{DRIVE}"}
        wanted = enrolment.Enrolment(
            servo.name, folder, servo.role, RATE, drive, _PLACEHOLDER, noise=servo.noise_mm * 1e-3
        )
        enrolment.enroll(path / TWIN, wanted)
        config = load(folder / EDGE)
        agent = replace(config.agent, retry=_RETRY, window_s=WINDOW_S, pre_trigger_s=PRE_TRIGGER_S)
        write_text(folder / EDGE, edge_toml(replace(config, agent=agent)))
        write_text(folder / MACHINE, machine_toml(servo))
    write_text(path / MARKER, msgspec.json.encode(Marker([servo.name for servo in SERVOS])).decode() + "\n")


@contextmanager
def _locked(path: Path) -> Iterator[int]:
    """The lock; what a killed start left behind keeps it until it has ended, which it does by itself."""
    end = time.monotonic() + ENDING_S
    with ExitStack() as stack:
        while True:
            try:
                descriptor = stack.enter_context(locked(path / LOCK))
                break
            except BlockingIOError:
                holder = (path / LOCK).read_bytes()[:32].decode("ascii", "replace").strip()
                if _alive(holder) or time.monotonic() > end:
                    told = f"is in use by another servotwin up (process {holder or 'unknown'})"
                    raise InvalidInput(f"folder {path}: {told}") from None
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
