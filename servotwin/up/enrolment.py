"""A servo made known: its token, the twin's verifier of it, and a folder with all that its edge needs."""

from __future__ import annotations

import re
import secrets
import shutil
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from servotwin.commissioning.edge_settings import Commissioning, Recording
from servotwin.config.table import did_you_mean, read_toml
from servotwin.edge_process.config import ROLES, UNBOOTED, EdgeConfig, TwinLink
from servotwin.edge_process.config_file import edge_toml, load
from servotwin.errors import InvalidInput
from servotwin.link.seal import verifier_of
from servotwin.messages import NAME_PATTERN
from servotwin.runtime.files import make_directory, write_text
from servotwin.twin_service.auth import PRIVATE, Verifiers, read_tokens, tokens_locked, write_private, write_tokens
from servotwin.twin_service.config import ServiceConfig
from servotwin.twin_service.twin_file import TwinFile, read_twin

TOKEN, CONFIG, CERTIFICATE = "token", "edge.toml", "ca.crt"
LONGEST_WINDOW_S, LONGEST_PRE_TRIGGER_S = 4.0, 0.3
"""What a twin with [twin.excitation] may ask an edge for: a calm loop turns the screw back late."""
SIMULATED: Mapping[str, object] = {"kind": "simulated", "address": "unix:drive.sock"}


@dataclass(frozen=True)
class Enrolment:
    """What is wanted of an edge.

    Attributes
    ----------
    servo : str
    folder : Path
        Made if it is missing.
    role : str
        "control" or "supervise".
    sample_rate : float
        Hz.
    drive : mapping
        The table [drive] of its file.
    url : str or None
        Where the edge reaches the twin; None: where the twin's file says that it listens.
    again : bool
        A servo that has a token gets another one; the former counts no more.
    noise : float
        m rms on the measured position, which the edge's watch has to put up with.
    ca : Path or None
        Certificates that the edge checks the twin's against. None: the twin's own where it has signed itself, else
        those of the edge's system.
    """

    servo: str
    folder: Path
    role: str = "supervise"
    sample_rate: float = 5000.0
    drive: Mapping[str, object] = field(default_factory=lambda: SIMULATED)
    url: str | None = None
    again: bool = False
    noise: float = 0.0
    ca: Path | None = None


def enroll(path: Path, wanted: Enrolment) -> list[Path]:
    """Make a servo known to the twin of that file; the files that were written.

    The edge's folder is written first: a token counts only once the edge has it. An edge.toml that is there stays.

    Raises
    ------
    InvalidInput
        The servo has no model, has a token already, or something cannot be written.
    """
    twin = read_twin(path)
    tokens = _tokens_file(twin)
    _check(wanted, _known(tokens))
    new = not (wanted.folder / CONFIG).exists()
    text = edge_toml(edge_config(twin, wanted)) if new else ""
    token, folder = secrets.token_urlsafe(32), make_directory(wanted.folder)
    made = _configured(_trusted(twin, wanted), folder, text) if new else []
    write_private(folder / TOKEN, token + "\n")
    made.append(folder / TOKEN)
    _add(tokens, "servos", wanted.servo, token, wanted.again)
    return [*made, tokens]


def enroll_operator(path: Path, name: str, file: Path, again: bool = False) -> list[Path]:
    """Make an operator known, whose token goes to `file`; as `enroll`."""
    twin = read_twin(path)
    tokens = _tokens_file(twin)
    _check_name(name, _known(tokens).operators, again)
    if file.exists() and not again:
        raise InvalidInput(f"{file}: is there already; give another file, or --again to replace it by a new token")
    token = secrets.token_urlsafe(32)
    write_private(file, token + "\n")
    _add(tokens, "operators", name, token, again)
    return [file, tokens]


def revoke(path: Path, name: str) -> Path:
    """Take a servo's or an operator's token from the twin of that file: it counts no more, at once; the tokens' file.

    Raises
    ------
    InvalidInput
        Nobody of that name has a token.
    """
    tokens = _tokens_file(read_twin(path))
    with tokens_locked(tokens):
        known = read_tokens(tokens)
        everybody = [*known.servos, *known.operators]
        if name not in everybody:
            raise InvalidInput(f"{tokens}: {name!r} has no token{did_you_mean(name, everybody)}")
        servos, operators = dict(known.servos), dict(known.operators)
        servos.pop(name, None)
        operators.pop(name, None)
        write_tokens(tokens, Verifiers(servos, operators))
    return tokens


def drive_of(path: Path | None) -> Mapping[str, object]:
    """The table [drive] that a TOML file holds; a simulated one without a file."""
    return SIMULATED if path is None else dict(read_toml(path).table("drive", required=True).values)


def edge_config(twin: TwinFile, wanted: Enrolment) -> EdgeConfig:
    """Configuration of a servo's edge: supervised as the twin's policy needs it.

    Raises
    ------
    InvalidInput
        The servo has no model, or nothing is verified for its stated range.
    """
    model = twin.fleet.model_of(wanted.servo)
    sampled = wanted.role == "control" or wanted.noise > 0.0
    law = model.servo.controller.replace(sample_rate=wanted.sample_rate if sampled else None)
    recording = Recording(
        sample_rate=wanted.sample_rate, longest_window=LONGEST_WINDOW_S, longest_pre_trigger=LONGEST_PRE_TRIGGER_S
    )
    servo = model.servo.replace(controller=law)
    commissioning = Commissioning(servo, law, model.settings, recording, noise=wanted.noise)
    commissioning.check_window()
    agent = commissioning.agent_settings(wanted.servo, UNBOOTED)
    certificate = None if _trusted(twin, wanted) is None else CERTIFICATE
    link = TwinLink(wanted.url or url_of(twin.service), token_file=TOKEN, ca_file=certificate)
    return EdgeConfig(agent, wanted.role, agent.controller or law, wanted.drive, link, folder=wanted.folder)


def url_of(service: ServiceConfig) -> str:
    """Where the service listens, as its file says.

    Raises
    ------
    InvalidInput
        It does not: any port, every address, or only a proxy reaches it.
    """
    if service.behind_proxy:
        raise InvalidInput("behind_proxy = true: say with --url where edges reach the proxy")
    if service.port == 0 or service.bind in ("0.0.0.0", "::"):
        raise InvalidInput(f"bind = {service.bind!r}, port = {service.port}: say with --url where edges reach the twin")
    host = f"[{service.bind}]" if ":" in service.bind else service.bind
    return f"{'http' if service.tls_key is None else 'https'}://{host}:{service.port}"


def _configured(certificates: Path | None, folder: Path, text: str) -> list[Path]:
    made = [write_text(folder / CONFIG, text)]
    if certificates is not None:
        made.append(Path(shutil.copyfile(certificates, folder / CERTIFICATE)))
    return made


def _trusted(twin: TwinFile, wanted: Enrolment) -> Path | None:
    """What the edge checks the twin's certificate against; None: what its system knows."""
    if wanted.ca is not None:
        _signers(wanted.ca)
        return wanted.ca
    own = twin.service.tls_certificate
    return own if own is not None and any(each["subject"] == each["issuer"] for each in _signers(own)) else None


def _signers(certificates: Path) -> list[Any]:
    """Those in a file that may sign others; raises InvalidInput where it holds no certificates."""
    try:
        return ssl.create_default_context(cafile=str(certificates)).get_ca_certs()
    except OSError as error:
        raise InvalidInput(f"{certificates}: holds no certificates that can be read ({error})") from None


def _tokens_file(twin: TwinFile) -> Path:
    if twin.service.tokens is None:
        raise InvalidInput(f'{twin.path}: [service] names no file of tokens; add tokens = "tokens.toml"')
    return twin.service.tokens


def _add(tokens: Path, role: str, name: str, token: str, again: bool) -> None:
    """To the file as it is now: others may have been enrolled meanwhile."""
    with tokens_locked(tokens):
        known = _known(tokens)
        there: Mapping[str, bytes] = getattr(known, role)
        _check_name(name, there, again)
        write_tokens(tokens, replace(known, **{role: {**there, name: verifier_of(token)}}))


def _known(tokens: Path) -> Verifiers:
    if not tokens.exists():
        tokens.touch(PRIVATE)
    return read_tokens(tokens)


def _check(wanted: Enrolment, known: Verifiers) -> None:
    if wanted.role not in ROLES:
        raise InvalidInput(f"role = {wanted.role!r} is not allowed; give one of {', '.join(ROLES)}")
    _check_name(wanted.servo, known.servos, wanted.again)
    _check_folder(wanted)


def _check_folder(wanted: Enrolment) -> None:
    """Another servo's edge is not given this one's token."""
    file, token = wanted.folder / CONFIG, wanted.folder / TOKEN
    whose = load(file).agent.servo if file.exists() else wanted.servo
    if whose != wanted.servo:
        raise InvalidInput(f"{file}: is that of servo {whose!r}; give {wanted.servo!r} another folder")
    if token.exists() and not wanted.again:
        raise InvalidInput(f"{token}: there is a token already; give --again to replace it by a new one")


def _check_name(name: str, known: Mapping[str, bytes], again: bool) -> None:
    if not re.match(NAME_PATTERN, name):
        raise InvalidInput(f"name {name!r}: 1 to 64 of A-Z a-z 0-9 . _ - are allowed")
    if name in known and not again:
        raise InvalidInput(f"{name!r} has a token already; give --again to replace it by a new one")
