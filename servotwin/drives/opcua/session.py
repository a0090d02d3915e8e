"""An OPC UA session in a thread of its own, behind blocking calls."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine, Mapping, Sequence
from concurrent.futures import TimeoutError as NoAnswer
from contextlib import suppress
from typing import Any, TypeVar

from servotwin.drives.opcua import model
from servotwin.drives.opcua.settings import OpcUaSettings
from servotwin.edge.drive import DriveLost, DriveRefused
from servotwin.errors import InvalidInput
from servotwin.runtime.extras import missing_extra

_Result = TypeVar("_Result")
_CLOSING_S = 2.0

_PERMANENT_ERRORS = (
    "BadCertificate",
    "BadIdentityToken",
    "BadNoMatch",
    "BadSecurity",
    "BadUserAccess",
    "BadUserSignature",
)
"""First parts of the names of errors that another try does not resolve."""


class OpcUaSession:
    """One connection, open from the start.

    Parameters
    ----------
    settings : OpcUaSettings

    Raises
    ------
    DriveLost
        The server does not answer.
    InvalidInput
        asyncua is not installed, the server refuses access, or it has no such drive.
    """

    def __init__(self, settings: OpcUaSettings) -> None:
        try:
            from asyncua import ua
            from asyncua.client.client import Client
            from asyncua.ua.uaerrors import BadNoMatch, UaError
        except ModuleNotFoundError:
            raise missing_extra("asyncua", "drive kind opcua") from None
        self._ua, self._settings = ua, settings
        self._failures = (OSError, TimeoutError, NoAnswer, asyncio.CancelledError, UaError, ValueError)
        self._missing = (BadNoMatch,)
        self._client = Client(settings.url, timeout=settings.silence_s)
        self._nodes: dict[str, Any] = {}
        self._types: dict[str, Any] = {}
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="opcua", daemon=True)
        self._thread.start()
        try:
            self._wait(self._connect())
        except BaseException:
            self.close()
            raise

    def read(self, names: Sequence[str]) -> list[Any]:
        """Read the values of variables in one request."""
        return self._wait(self._client.read_values([self._nodes[name] for name in names]))

    def write(self, values: Mapping[str, Any]) -> None:
        """Set variables in one request.

        Raises
        ------
        DriveRefused
            The server refuses one of them.
        """
        nodes = [self._nodes[name] for name in values]
        typed = [self._typed(name, value) for name, value in values.items()]
        statuses = self._wait(self._client.write_values(nodes, typed, raise_on_partial_error=False))
        for name, status in zip(values, statuses, strict=True):
            if not status.is_good():
                raise DriveRefused(f"OPC UA variable {name} = {values[name]!r}: {status.name}")

    def has(self, name: str) -> bool:
        """True where the drive has a variable that not every drive has."""
        return name in self._nodes

    def close(self) -> None:
        """End the session, the thread and its loop."""
        if self._loop.is_closed():
            return
        asyncio.run_coroutine_threadsafe(self._end(), self._loop)
        self._thread.join(2.0 * _CLOSING_S)
        if not self._thread.is_alive():
            self._loop.close()

    async def _connect(self) -> None:
        s, client = self._settings, self._client
        if s.user is not None and s.password is not None:
            client.set_user(s.user)
            client.set_password(s.password)
        if s.certificate is not None and s.private_key is not None and s.server_certificate is not None:
            from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

            await client.set_security(
                SecurityPolicyBasic256Sha256,
                str(s.certificate),
                str(s.private_key),
                server_certificate=str(s.server_certificate),
            )
        await client.connect()
        place = await client.get_namespace_index(model.NAMESPACE)
        drive = await client.nodes.objects.get_child(f"{place}:{s.node}")
        self._nodes = {name: await drive.get_child(f"{place}:{name}") for name in model.EVERY}
        for name in model.GAINS:
            with suppress(*self._missing):
                self._nodes[name] = await drive.get_child(f"{place}:{name}")
        for name in filter(self.has, (*model.PARAMETERS, model.COMMIT, *model.GAINS)):
            self._types[name] = await self._nodes[name].read_data_type_as_variant_type()

    def _typed(self, name: str, value: Any) -> Any:
        return self._ua.DataValue(self._ua.Variant(value, self._types[name]))

    def _wait(self, work: Coroutine[Any, Any, _Result]) -> _Result:
        """Run a coroutine in the loop's thread and return its result."""
        waiting = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return waiting.result(2.0 * self._settings.silence_s)
        except self._failures as error:
            waiting.cancel()
            raise self._meaning(error) from None

    def _meaning(self, error: BaseException) -> Exception:
        """Convert an error of the OPC UA stack to one of the drive's."""
        name, url = type(error).__name__, self._settings.url
        message = f"drive {url}: {name}" + (f" ({error})" if str(error) else "")
        missing = isinstance(error, ValueError) and not isinstance(error, OSError)
        return InvalidInput(message) if missing or name.startswith(_PERMANENT_ERRORS) else DriveLost(message)

    async def _end(self) -> None:
        """Disconnect, and cancel the tasks that are left."""
        with suppress(*self._failures):
            await asyncio.wait_for(self._client.disconnect(), _CLOSING_S)
        rest = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for task in rest:
            task.cancel()
        await asyncio.gather(*rest, return_exceptions=True)
        self._loop.call_soon(self._loop.stop)
