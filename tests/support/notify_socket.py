"""A service manager's socket, which notes what a service says."""

import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class NotifySocket:
    """Socket to which a service sends its state; `path` is for `NOTIFY_SOCKET`."""

    def __init__(self, path: Path) -> None:
        self.path, self.states = path, list[str]()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.setblocking(False)

    def received(self) -> list[str]:
        """All states so far, in order."""
        while True:
            try:
                self.states.append(self._socket.recv(4096).decode())
            except BlockingIOError:
                return self.states

    def wait_for(self, state: str, number: int = 1, seconds: float = 60.0) -> None:
        """Wait until a state came that many times."""
        end = time.monotonic() + seconds
        while self.received().count(state) < number:
            assert time.monotonic() < end, self.states
            time.sleep(0.02)

    def close(self) -> None:
        self._socket.close()


@contextmanager
def listening() -> Iterator[NotifySocket]:
    """A socket in a folder of its own: the name of a Unix socket has at most 107 bytes."""
    with tempfile.TemporaryDirectory() as folder:
        made = NotifySocket(Path(folder) / "notify")
        try:
            yield made
        finally:
            made.close()
