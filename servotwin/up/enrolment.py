"""Enrolment of servos and operators: their tokens, the twin's verifiers, and the folder that an edge starts from."""

from __future__ import annotations

import re
import secrets
import shutil
import ssl
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from servotwin.commissioning.edge_settings import Commissioning, Recording
from servotwin.config.table import did_you_mean, read_toml
from servotwin.control.laws import AnyController
from servotwin.control.linear_law import LinearLaw
from servotwin.edge_process.config import ROLES, UNBOOTED, EdgeConfig, TwinLink
from servotwin.edge_process.config_file import edge_toml, load
from servotwin.edge_process.drive import check_drive
from servotwin.errors import InvalidInput
from servotwin.link.seal import verifier_of
from servotwin.messages import NAME_PATTERN
from servotwin.plant.display_units import position_unit
from servotwin.plant.own_units import own_units
from servotwin.plant.plants import Plant
from servotwin.runtime.files import make_directory, write_text
from servotwin.twin_service.auth import Verifiers, read_tokens, tokens_locked, write_private, write_tokens
from servotwin.twin_service.config import ServiceConfig
from servotwin.twin_service.twin_file import TwinFile, read_twin

if TYPE_CHECKING:
    from servotwin.twin.model_registry import ServoModel

TOKEN, CONFIG, CERTIFICATE = "token", "edge.toml", "ca.crt"
LONGEST_WINDOW_S, LONGEST_PRE_TRIGGER_S = 4.0, 0.3
"""Limits of the windows that a twin with [twin.excitation] may request, in the servo's own seconds: a calm loop
reverses the screw late."""
_RATE = 5000.0  # Hz
SIMULATED: Mapping[str, object] = {"kind": "simulated", "address": "unix:drive.sock"}


class StatedNoise(NamedTuple):
    """Noise on a measured position, rms.

    Attributes
    ----------
    value : float
    unit : str
        "um", or "mdeg" of a rotary axis.
    """

    value: float = 0.0
    unit: str = "um"

    def si_of(self, servo: Plant) -> float:
        """The noise in the unit that a servo has inside, m or rad.

        Raises
        ------
        InvalidInput
            The servo counts its position in another unit.
        """
        own = position_unit(servo).small
        if self.value and self.unit != own.name:
            raise InvalidInput(f"noise_{self.unit} = {self.value!r}: this servo's position needs noise_{own.name}")
        return own.si_of(self.value)


NO_NOISE = StatedNoise()


@dataclass(frozen=True)
class Enrolment:
    """Request to enrol a servo.

    Attributes
    ----------
    servo : str
    folder : Path
        Created if it is missing.
    role : str
        "control" or "supervise".
    sample_rate : float or None
        Hz; None: that of the servo's own controller, or 5000 where that has none.
    drive : mapping
        The table [drive] of the edge's file.
    url : str or None
        Address at which the edge reaches the twin; None: that of the twin's file.
    replace_token : bool
        Replace an existing token, which thereby becomes invalid.
    noise : StatedNoise
        Noise that the edge's watch is set to tolerate.
    ca : Path or None
        Certificates against which the edge checks the twin's. None: the twin's own if it is self-signed, otherwise
        those of the edge's system.
    """

    servo: str
    folder: Path
    role: str = "supervise"
    sample_rate: float | None = None
    drive: Mapping[str, object] = field(default_factory=lambda: SIMULATED)
    url: str | None = None
    replace_token: bool = False
    noise: StatedNoise = NO_NOISE
    ca: Path | None = None


def enroll(path: Path, request: Enrolment) -> list[Path]:
    """Enrol a servo with the twin of a file, and return the files that were written.

    The edge's folder is written first, so that a token becomes valid only once the edge has it. An existing edge.toml
    stays as it is.

    Raises
    ------
    InvalidInput
        The servo has no model, it has a token already, or a file cannot be written.
    """
    twin = read_twin(path)
    enroller = Enroller(twin)
    text = enroller.text(request, present_tokens(twin))
    with open_tokens(twin) as (tokens, known):
        written, verifier = enroller.write(request, enroller.text(request, known, text))
        write_tokens(tokens, replace(known, servos={**known.servos, request.servo: verifier}))
    return [*written, tokens]


class Enroller:
    """Makes the folders of edges; what edges of one model have in common is computed once.

    Parameters
    ----------
    twin : TwinFile
    """

    def __init__(self, twin: TwinFile) -> None:
        self._twin = twin
        self._configs = dict[tuple[object, ...], EdgeConfig]()
        self._certificates = dict[Path | None, Path | None]()

    def text(self, request: Enrolment, known: Verifiers, made: str = "") -> str:
        """Check a request, and return the text of its edge.toml (`made` before, if any); "" where there is one already.

        Raises
        ------
        InvalidInput
            The servo has no model, it or its folder has a token already, its drive cannot be what is stated, or no
            setting is verified for its stated range.
        """
        _check(request, known)
        return "" if (request.folder / CONFIG).exists() else made or edge_toml(self._config(request))

    def write(self, request: Enrolment, text: str, durable: bool = True) -> tuple[list[Path], bytes]:
        """Write the folder of an edge with a new token; return the files and the token's verifier."""
        token, folder = secrets.token_urlsafe(32), make_directory(request.folder)
        written = _write_configuration(self._trusted(request), folder, text) if text else []
        write_private(folder / TOKEN, token + "\n", durable)
        return [*written, folder / TOKEN], verifier_of(token)

    def _config(self, request: Enrolment) -> EdgeConfig:
        model = _model_of(self._twin, request.servo)
        key = model.name, request.role, request.sample_rate, repr(request.drive), request.url, request.noise, request.ca
        if key not in self._configs:
            self._configs[key] = _edge_config(self._twin, model, request, self._trusted(request))
        config = self._configs[key]
        config = replace(config, agent=replace(config.agent, servo=request.servo), folder=request.folder)
        check_drive(replace(config, source=str(config.folder / CONFIG)))
        return config

    def _trusted(self, request: Enrolment) -> Path | None:
        if request.ca not in self._certificates:
            self._certificates[request.ca] = _trusted_certificates(self._twin, request)
        return self._certificates[request.ca]


def present_tokens(twin: TwinFile) -> Verifiers:
    """Read a twin's verifiers as they are now, without the lock."""
    tokens = _tokens_file(twin)
    return read_tokens(tokens) if tokens.exists() else Verifiers()


@contextmanager
def open_tokens(twin: TwinFile) -> Iterator[tuple[Path, Verifiers]]:
    """Hold the lock of a twin's file of tokens; yield its path and verifiers, for `write_tokens`."""
    tokens = _tokens_file(twin)
    with tokens_locked(tokens):
        yield tokens, present_tokens(twin)


def enroll_operator(
    path: Path, name: str, file: Path, replace_token: bool = False, engineer: bool = False
) -> list[Path]:
    """Enrol an operator, or an engineer, with the twin of a file, and write the token to `file`.

    Returns and raises as `enroll` does.
    """
    twin = read_twin(path, models=False)
    with open_tokens(twin) as (tokens, known):
        role, other = (known.engineers, known.operators) if engineer else (known.operators, known.engineers)
        _check_name(name, role, replace_token)
        if name in other:
            raise InvalidInput(f"{name!r} has a token of the other role already; `servotwin revoke {name}` ends it")
        if file.exists() and not replace_token:
            raise InvalidInput(f"{file}: exists already; give another file, or --again to replace it by a new token")
        token = secrets.token_urlsafe(32)
        write_private(file, token + "\n")
        entries = {**role, name: verifier_of(token)}
        write_tokens(tokens, replace(known, engineers=entries) if engineer else replace(known, operators=entries))
    return [file, tokens]


def revoke(path: Path, name: str) -> Path:
    """Revoke the token of a servo, an operator or an engineer at the twin of a file, and return the file of tokens.

    Raises
    ------
    InvalidInput
        Nobody of that name has a token.
    """
    tokens = _tokens_file(read_twin(path, models=False))
    with tokens_locked(tokens):
        known = read_tokens(tokens)
        names = [*known.servos, *known.readers]
        if name not in names:
            raise InvalidInput(f"{tokens}: {name!r} has no token{did_you_mean(name, names)}")
        servos, operators, engineers = (
            {each: token for each, token in of.items() if each != name}
            for of in (known.servos, known.operators, known.engineers)
        )
        write_tokens(tokens, Verifiers(servos, operators, engineers, known.fleet))
    return tokens


def drive_of(path: Path | None) -> Mapping[str, object]:
    """Read the table [drive] of a TOML file; without a file, return that of a simulated drive."""
    return SIMULATED if path is None else dict(read_toml(path).table("drive", required=True).values)


def _model_of(twin: TwinFile, servo: str) -> ServoModel:
    fleet = twin.fleet
    try:
        return fleet.model_of(servo)
    except InvalidInput as error:
        raise InvalidInput(f"{twin.path}: {error}") from None


def _edge_config(twin: TwinFile, model: ServoModel, request: Enrolment, certificates: Path | None) -> EdgeConfig:
    """Make the configuration of a servo's edge, with the supervision that the twin's policy requires.

    Raises
    ------
    InvalidInput
        The loop is unstable at the rate of the edge, or no setting is verified for the stated range.
    """
    own = model.servo.controller
    rate = (own.sample_rate or _RATE) if request.sample_rate is None else request.sample_rate
    law = _running_law(own, request, rate)
    servo = model.servo.replace(controller=law)
    servo.check_loop(law)
    commissioning = Commissioning(servo, law, model.settings, Recording(rate), noise=request.noise.si_of(servo))
    most = twin.service.samples_per_window
    commissioning = commissioning.with_longest(LONGEST_WINDOW_S, LONGEST_PRE_TRIGGER_S, most)
    commissioning.check_window()
    agent = commissioning.agent_settings(request.servo, UNBOOTED)
    certificate = None if certificates is None else CERTIFICATE
    link = TwinLink(request.url or _url_of(twin.service), token_file=TOKEN, ca_file=certificate)
    units = own_units(servo)
    return EdgeConfig(
        agent,
        request.role,
        agent.controller or law,
        request.drive,
        link,
        command_unit=units.command,
        position_unit=units.position,
        folder=request.folder,
    )


def _running_law(own: AnyController, request: Enrolment, rate: float) -> AnyController:
    """The law that runs: the edge's at the rate (Hz) of its samples, a drive's at its own.

    Raises
    ------
    InvalidInput
        The edge is to tick a law that was made for another rate.
    """
    if request.role != "control" and (own.sample_rate is not None or not request.noise.value):
        return own
    if isinstance(own, LinearLaw) and own.discrete and own.sample_rate != rate:
        raise InvalidInput(
            f"sample_rate_hz = {rate!r} Hz: the servo's controller has matrices for {own.sample_rate!r} Hz; give that"
        )
    return own.replace(sample_rate=rate)


def _url_of(service: ServiceConfig) -> str:
    """URL at which the service listens, from its settings.

    Raises
    ------
    InvalidInput
        The settings do not determine it: they name any port or all addresses, or a proxy is in front.
    """
    if service.behind_proxy:
        raise InvalidInput("behind_proxy = true: give the address of the proxy with --url")
    if service.port == 0 or service.bind in ("0.0.0.0", "::"):
        raise InvalidInput(f"bind = {service.bind!r}, port = {service.port}: give the address of the twin with --url")
    host = f"[{service.bind}]" if ":" in service.bind else service.bind
    return f"{'http' if service.tls_key is None else 'https'}://{host}:{service.port}"


def _write_configuration(certificates: Path | None, folder: Path, text: str) -> list[Path]:
    """Write edge.toml last: an enrolment that finds one, after one that was interrupted, writes no certificates."""
    written = []
    if certificates is not None:
        written.append(Path(shutil.copyfile(certificates, folder / CERTIFICATE)))
    return [*written, write_text(folder / CONFIG, text)]


def _trusted_certificates(twin: TwinFile, request: Enrolment) -> Path | None:
    """Certificates against which the edge checks the twin's; None: those of its system."""
    if request.ca is not None:
        _authorities(request.ca)
        return request.ca
    own = twin.service.tls_certificate
    return own if own is not None and any(one["subject"] == one["issuer"] for one in _authorities(own)) else None


def _authorities(certificates: Path) -> list[Any]:
    """Certificates of a file that may sign others; raises InvalidInput where it holds none."""
    try:
        return ssl.create_default_context(cafile=str(certificates)).get_ca_certs()
    except OSError as error:
        raise InvalidInput(f"{certificates}: holds no certificates that can be read ({error})") from None


def _tokens_file(twin: TwinFile) -> Path:
    if twin.service.tokens is None:
        raise InvalidInput(f'{twin.path}: [service] has no key tokens; add tokens = "tokens.toml"')
    return twin.service.tokens


def _check(request: Enrolment, known: Verifiers) -> None:
    if request.role not in ROLES:
        raise InvalidInput(f"role = {request.role[:80]!r} is not allowed; give one of {', '.join(ROLES)}")
    _check_name(request.servo, known.servos, request.replace_token)
    _check_folder(request)


def _check_folder(request: Enrolment) -> None:
    """Refuse a folder that belongs to another servo's edge, or that has a token already."""
    file, token = request.folder / CONFIG, request.folder / TOKEN
    try:
        request.folder.stat()
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InvalidInput(f"{request.folder}: cannot be the folder of an edge ({why})") from None
    owner = load(file).agent.servo if file.exists() else request.servo
    if owner != request.servo:
        raise InvalidInput(f"{file}: belongs to servo {owner!r}; give {request.servo!r} another folder")
    if token.exists() and not request.replace_token:
        raise InvalidInput(f"{token}: exists already; give --again to replace it by a new one")


def _check_name(name: str, known: Mapping[str, bytes], replace_token: bool) -> None:
    if not re.match(NAME_PATTERN, name):
        raise InvalidInput(f"name {name[:80]!r}: 1 to 64 of A-Z a-z 0-9 . _ - are allowed")
    if name in known and not replace_token:
        raise InvalidInput(f"{name!r} has a token already; give --again to replace it by a new one")
