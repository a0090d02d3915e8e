"""Atomic replacement of files, and checks of output paths before a long computation."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from servotwin.errors import InvalidInput


def replace_file(path: Path, data: bytes, *, durable: bool = False, mode: int | None = None) -> None:
    """Write a file whole or not at all: a crash leaves the old one or the new one.

    The data go to a neighbour NAME.new first, which is renamed. Only one process at a time may replace a file.

    Parameters
    ----------
    path : Path
        Its folder exists.
    data : bytes
    durable : bool
        Return only when the data are on the disk.
    mode : int, optional
        Permissions of the file; None: those of any new file.

    Raises
    ------
    OSError
    """
    beside = path.with_name(f"{path.name}.new")
    if mode is not None:
        beside.unlink(missing_ok=True)  # a process that has an old, readable NAME.new open would read the secret
    try:
        with open(beside, "wb", opener=partial(os.open, mode=0o666 if mode is None else mode)) as file:
            if mode is not None:
                # The umask may have removed bits that `mode` has.
                os.fchmod(file.fileno(), mode)
            file.write(data)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        beside.replace(path)
    except BaseException:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        raise


def file_identity(place: Path) -> tuple[int, int] | tuple[()] | None:
    """Device and inode of the file in a place; (): there is none; None: it cannot be told."""
    try:
        status = place.stat()
    except FileNotFoundError:
        return ()
    except OSError:
        return None
    return status.st_dev, status.st_ino


class FilesInPlace:
    """Files that a process has open, by their places.

    Parameters
    ----------
    places : iterable of Path
        Those in which there is no file, or none that can be looked at, are left out.
    """

    def __init__(self, places: Iterable[Path]) -> None:
        self._known = {place: one for place in places if (one := file_identity(place))}

    def changed(self) -> list[Path]:
        """Places whose file was deleted, moved or replaced since: what is written to it is gone with the process."""
        return [place for place, one in self._known.items() if file_identity(place) not in (one, None)]


@contextmanager
def atomic_output(path: Path, mode: int | None = None) -> Iterator[Path]:
    """Yield a temporary path beside `path`, renamed to it when the block ends well and removed when it does not.

    The file gets the permissions `mode`; None: those of any new file.

    Raises
    ------
    InvalidInput
        The file cannot be written, for example on a full disk.
    """
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            temporary.chmod(0o666 & ~_umask() if mode is None else mode)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise InvalidInput(f"output {path}: cannot be written ({error.strerror or error})") from None


def write_text(path: Path, text: str) -> Path:
    """Write a text file atomically and return its path."""
    with atomic_output(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def write_and_print(path: Path, text: str, say: Callable[..., None]) -> None:
    """Write a text file atomically and print its path; `say` is the `print` of a rich console."""
    write_text(path, text)
    say(f"written: {path}", soft_wrap=True, highlight=False)


def check_file(path: Path, suffixes: tuple[str, ...]) -> Path:
    """Refuse an output path that cannot be written: wrong suffix, no such directory, a directory in its place.

    Raises
    ------
    InvalidInput
        Naming the path and what is allowed.
    """
    if path.suffix not in suffixes:
        raise InvalidInput(f"output {path}: the suffix {path.suffix!r} is not known: allowed are {', '.join(suffixes)}")
    if path.is_dir():
        raise InvalidInput(f"output {path}: is a directory; give the name of a file")
    if not path.parent.is_dir():
        raise InvalidInput(f"output {path}: there is no directory {path.parent}; make it first or choose another")
    _check_writable(path.parent)
    return path


def make_directory(path: Path) -> Path:
    """Make a directory, with its parents, if it is missing, and return its path.

    Raises
    ------
    InvalidInput
        The directory cannot be made or written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInput(f"output directory {path}: cannot be made ({error.strerror})") from None
    _check_writable(path)
    return path


def _check_writable(directory: Path) -> None:
    try:
        tempfile.TemporaryFile(dir=directory).close()
    except OSError:
        raise InvalidInput(f"output directory {directory}: may not be written to; choose another") from None


def _umask() -> int:
    # The mask can only be read by setting it.
    mask = os.umask(0)
    os.umask(mask)
    return mask
