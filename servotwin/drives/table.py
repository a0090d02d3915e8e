"""The table [drive] of an edge's file: the drive's kind and options. Each kind is imported when it is used."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, TypeVar

from servotwin.config.files import readable, secret_file, secret_in
from servotwin.config.keys import Form, key
from servotwin.config.table import Table
from servotwin.config.toml import read_kind
from servotwin.edge.drive import ControlDrive, SupervisedDrive

_Drive = TypeVar("_Drive")
_ADDRESS = "unix:PATH of the machine's socket, relative to this file, or 127.0.0.1:PORT."
_SILENCE = "Time without an answer, or a new sample, after which the drive counts as lost."


def control_drive(table: Table, folder: Path) -> ControlDrive:
    """Make a drive whose voltage the edge sets; it is not connected yet. Paths are relative to `folder`.

    Raises
    ------
    InvalidInput
        A key is unknown, missing or not allowed, or drives of this kind do not have the role control.
    """
    return _read(table, folder, CONTROLLED)


def supervised_drive(table: Table, folder: Path, motor_encoder: bool = True) -> SupervisedDrive:
    """Make a drive with its own controller; see `control_drive`. Without `motor_encoder` a log may lack the angle."""
    kinds = SUPERVISED if motor_encoder else {**SUPERVISED, "replay": _replay_without_motor}
    return _read(table, folder, kinds)


def _read(table: Table, folder: Path, kinds: Mapping[str, Callable[..., _Drive]]) -> _Drive:
    drive: _Drive = read_kind(table, kinds, folder)
    return drive


def _socket(_table: Table, _name: str, address: str, folder: Path) -> str:
    """Resolve the path of a machine's socket."""
    kind, _, path = address.partition(":")
    return f"unix:{folder / path}" if kind == "unix" and path else address


def _variable(_table: Table, _name: str, variable: str, _folder: Path) -> str:
    """Read the secret in an environment variable."""
    return secret_in(os.environ, variable)


def _log(table: Table, name: str, path: Path, folder: Path, motor_encoder: bool = True) -> Path:
    from servotwin.drives.replay import check_begin

    check_begin(readable(table, name, path, folder), motor_encoder, table.units)
    return path


def _certificate(table: Table, name: str, path: Path, folder: Path) -> Path:
    from servotwin.drives.opcua.settings import check_certificate

    check_certificate(readable(table, name, path, folder))
    return path


def _private_key(table: Table, name: str, path: Path, folder: Path) -> Path:
    from servotwin.drives.opcua.settings import check_private_key

    check_private_key(readable(table, name, path, folder))
    return path


def _controlled(
    address: Annotated[str, key(parse=_socket, help=_ADDRESS)],
    silence_s: Annotated[float, key(minimum=0.0, help=_SILENCE)] = 5.0,
) -> ControlDrive:
    """Simulated machine whose voltage the edge sets."""
    from servotwin.drives.simulated.client import SimulatedControl

    return SimulatedControl(address, silence_s)


def _supervised(
    address: Annotated[str, key(parse=_socket, help=_ADDRESS)],
    silence_s: Annotated[float, key(minimum=0.0, help=_SILENCE)] = 5.0,
) -> SupervisedDrive:
    """Simulated machine with its own controller."""
    from servotwin.drives.simulated.client import SimulatedSupervised

    return SimulatedSupervised(address, silence_s)


def _replay(
    log: Annotated[Path, key(parse=_log, help="CSV as `servotwin simulate` writes it.")],
    speed: Annotated[float, key(minimum=0.0, help="Seconds of the log per second; 0: as fast as it is read.")] = 1.0,
    loop: Annotated[bool, key(help="Begin again at the end.")] = False,
    block_s: Annotated[float, key(above=0.0, help="Length of a block.")] = 0.05,
) -> SupervisedDrive:
    """Recorded log in place of a machine."""
    from servotwin.drives.replay import Replay

    return Replay(log, speed, loop, block_s)


def _replay_without_motor(
    log: Annotated[Path, key(parse=partial(_log, motor_encoder=False), help="CSV; the motor's angle may be absent.")],
    speed: Annotated[float, key(minimum=0.0, help="Seconds of the log per second; 0: as fast as it is read.")] = 1.0,
    loop: Annotated[bool, key(help="Begin again at the end.")] = False,
    block_s: Annotated[float, key(above=0.0, help="Length of a block.")] = 0.05,
) -> SupervisedDrive:
    """Recorded log of a motor without encoder."""
    from servotwin.drives.replay import Replay

    return Replay(log, speed, loop, block_s, motor_encoder=False)


def _opcua(
    url: Annotated[str, key(help="opc.tcp://HOST:PORT[/PATH].")],
    node: Annotated[
        str | None, key(help="Browse name of the drive's object below Objects; the model's where absent.")
    ] = None,
    user: Annotated[str | None, key(help="User; without certificates on this machine only.")] = None,
    password: Annotated[
        str | None,
        key("password_file", form=Form.PATH, parse=secret_file, help="File of mode 0600 with the user's password."),
    ] = None,
    password_env: Annotated[
        str | None, key(parse=_variable, help="Environment variable with the user's password.")
    ] = None,
    certificate: Annotated[
        Path | None,
        key(
            parse=_certificate,
            help="The edge's certificate: NAME.pem in PEM, any other in DER; all three files or none.",
        ),
    ] = None,
    private_key: Annotated[Path | None, key(parse=_private_key, help="Its private key.")] = None,
    server_certificate: Annotated[Path | None, key(parse=_certificate, help="Certificate of the server.")] = None,
    poll_s: Annotated[
        float,
        key(above=0.0, help="Interval between two readings of the samples; the rings must hold several times as much."),
    ] = 0.05,
    silence_s: Annotated[float, key(above=0.0, help=_SILENCE)] = 5.0,
) -> SupervisedDrive:
    """OPC UA drive."""
    from servotwin.drives.opcua.drive import OpcUaDrive
    from servotwin.drives.opcua.settings import OpcUaSettings

    return OpcUaDrive(
        OpcUaSettings(
            url=url,
            node=OpcUaSettings.node if node is None else node,
            user=user,
            password=password if password_env is None else password_env,
            certificate=certificate,
            private_key=private_key,
            server_certificate=server_certificate,
            poll_s=poll_s,
            silence_s=silence_s,
        )
    )


CONTROLLED: Mapping[str, Callable[..., ControlDrive]] = {"simulated": _controlled}
SUPERVISED: Mapping[str, Callable[..., SupervisedDrive]] = {
    "simulated": _supervised, "replay": _replay, "opcua": _opcua,
}  # fmt: skip
