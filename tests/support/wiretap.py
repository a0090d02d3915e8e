"""A server with faults of TLS, which keeps every byte that a client trusts it with."""

import socket
import ssl
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread


class Wiretap:
    """Listens on a free port of this machine; `certificate` is a pair of PEM files, None: no TLS."""

    def __init__(
        self,
        certificate: tuple[Path, Path] | None = None,
        version: ssl.TLSVersion | None = None,
        mute: bool = False,
        answer: bytes = b"",
        mutual: bool = False,
    ) -> None:
        self.received, self.connected = bytearray(), Event()
        self._mute, self._answer, self._ended = mute, answer, Event()
        self._context = None if certificate is None else _context(certificate, version)
        if mutual and self._context is not None:
            self._context.verify_mode = ssl.CERT_REQUIRED
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._thread = Thread(target=self._serve)
        self._thread.start()

    def close(self) -> None:
        self._ended.set()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listener.close()

    def _serve(self) -> None:
        while not self._ended.is_set():
            with suppress(OSError):
                self._talk(self._listener.accept()[0])

    def _talk(self, connection: socket.socket) -> None:
        with connection:
            connection.settimeout(5.0)
            self.connected.set()
            if self._mute:
                self._ended.wait()
                return
            if self._context is None:
                self.received += connection.recv(65536)
                connection.sendall(self._answer)
                return
            with self._context.wrap_socket(connection, server_side=True) as encrypted:
                self.received += encrypted.recv(65536)


def _context(certificate: tuple[Path, Path], version: ssl.TLSVersion | None) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    if version is not None:
        with warnings.catch_warnings(action="ignore"):
            context.set_ciphers("DEFAULT:@SECLEVEL=0")
            context.minimum_version = context.maximum_version = version
    context.load_cert_chain(*certificate)
    return context


@contextmanager
def wiretap(
    certificate: tuple[Path, Path] | None = None,
    version: ssl.TLSVersion | None = None,
    mute: bool = False,
    answer: bytes = b"",
    mutual: bool = False,
) -> Iterator[Wiretap]:
    """One that runs; `mute`: it says nothing, `mutual`: it wants a certificate of its client."""
    made = Wiretap(certificate, version, mute, answer, mutual)
    try:
        yield made
    finally:
        made.close()
