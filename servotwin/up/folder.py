"""Folder of `servotwin up`: created atomically, locked by one process, resumed at the next start."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from servotwin.drives.simulated.machine_state import MachineState, read_state
from servotwin.edge_process.config_file import edge_toml, load
from servotwin.errors import InvalidInput
from servotwin.runtime.files import write_text
from servotwin.runtime.locks import locked
from servotwin.twin_service.auth import Verifiers, write_tokens
from servotwin.up.demonstration import Demonstration
from servotwin.up.enrolment import TOKEN, enroll_operator
from servotwin.up.plan import DRIVE, EDGE, LOCK, MACHINE, OPERATOR, TWIN, Plan, ServoPlan

MARKER = "servotwin-up.json"
LONGEST = 100
"""Bytes of a socket's path that every system accepts: Linux allows 107, macOS 103."""
_ENDING_S = 25.0
"""s that processes of an earlier start, which was killed, may take to end."""


class _Marker(msgspec.Struct, frozen=True, tag="servotwin-up/2", tag_field="schema"):
    """Marks a folder as made by `servotwin up`; its servos, their speed, and the digest of what it was made from."""

    servos: tuple[ServoPlan, ...]
    speed: float | None
    digest: str


@dataclass(frozen=True)
class Folder:
    """A complete, locked folder.

    Attributes
    ----------
    path : Path
        Absolute.
    servos : tuple of ServoPlan
    speed : float or None
        Machine time per time; None: as fast as the processor's share allows.
    lock : int
        Descriptor of the lock, which every process that works in the folder keeps open.
    new : bool
        True: it was made by this start.
    """

    path: Path
    servos: tuple[ServoPlan, ...]
    speed: float | None
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
def opened(
    path: Path, plan: Plan | None = None, making: Callable[[Path, Plan], None] | None = None
) -> Iterator[Folder]:
    """Open the folder, made at the first start, and lock it for this process.

    Parameters
    ----------
    path : Path
    plan : Plan, optional
        What it is made from, or was made from. None: whatever is in it; a new one has the demonstration.
    making : callable, optional
        Called with folder and plan before it is made, which takes minutes where code has to be compiled first.

    Raises
    ------
    InvalidInput
        It holds something else, is in use, or cannot be written.
    """
    path = path.absolute()
    try:
        new = not path.exists() or not any(path.iterdir())
        if new:
            first = plan or Demonstration()
            _check_length(path, first.servos)
            if making is not None:
                making(path, first)
            _make(path, first)
        marker = _marker(path, plan)
        _check_length(path, marker.servos)
        with _locked(path) as lock:
            yield Folder(path, marker.servos, marker.speed, lock, new)
    except OSError as error:
        raise InvalidInput(f"{error.filename or path}: {(error.strerror or str(error)).lower()}") from None


def _check_length(path: Path, servos: Iterable[ServoPlan]) -> None:
    longest = max(len(os.fsencode(path / servo.name / DRIVE)) for servo in servos)
    if longest > LONGEST:
        fault = f"its path is {longest - LONGEST} bytes too long for the sockets in it"
        raise InvalidInput(f"folder {path}: {fault}; choose a shorter one with --folder")


def _marker(path: Path, plan: Plan | None) -> _Marker:
    """Read the marker, and check that the folder is whole and was made from the plan."""
    try:
        marker = msgspec.json.decode((path / MARKER).read_bytes(), type=_Marker)
    except (OSError, msgspec.MsgspecError):
        allowed = "choose another with --folder, or one that is empty or not there yet"
        raise InvalidInput(f"folder {path}: was not made by this version of servotwin up; {allowed}") from None
    names = [servo.name for servo in marker.servos]
    needed = [TWIN, OPERATOR, *(f"{name}/{file}" for name in names for file in (EDGE, MACHINE, TOKEN))]
    missing = [name for name in needed if not (path / name).is_file()]
    fault = f"{missing[0]} is missing" if missing else ""
    if plan is not None and plan.digest != marker.digest:
        fault = f"was made from other scenarios or axes (its servos are {', '.join(names)})"
    if fault:
        raise InvalidInput(f"folder {path}: {fault}; remove the folder to begin anew, or choose another with --folder")
    return marker


def _make(path: Path, plan: Plan) -> None:
    """Make everything in a temporary folder beside it, then rename that one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    try:
        _fill(temporary, plan)
        with suppress(FileExistsError):  # another start was quicker
            temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _fill(path: Path, plan: Plan) -> None:
    write_tokens(path / "tokens.toml", Verifiers())
    plan.write_twin(path)
    enroll_operator(path / TWIN, "up", path / OPERATOR)
    for servo in plan.servos:
        plan.write_servo(servo, path)
    marker = _Marker(plan.servos, plan.speed, plan.digest)
    write_text(path / MARKER, msgspec.json.encode(marker).decode() + "\n")


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
