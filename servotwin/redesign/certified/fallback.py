"""Certificates of fallback sets, kept on disk: every process of a twin would otherwise verify the same setting anew.

A file's name is the digest of everything that its certificate depends on: model, uncertainty, demands and trial in
full, the source code, the versions of the numerical libraries and the processor. What is not readable as such a file
counts as absent, and is replaced.
"""

from __future__ import annotations

import hashlib
import os
import platform
import stat
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding
import msgspec
from msgspec import Struct

from servotwin.errors import InvalidInput
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import Uncertainty, in_words
from servotwin.redesign.certified.ways_out import ways_out
from servotwin.redesign.design import decoded_part
from servotwin.runtime.files import atomic_output
from servotwin.runtime.user_cache import cache_folder, source_digest

MOST_FILES = 256
"""Files that the folder keeps; the oldest are removed."""
_SUFFIX = ".certificate"
_LARGEST = 1024 * 1024  # bytes
_DIGEST = hashlib.sha256().digest_size


class CertificateFile(Struct, frozen=True, tag="fallback-certificate/1"):
    """Content of a file, behind its SHA-256.

    Attributes
    ----------
    of : dict of str to str
        Everything that the certificate depends on, in full.
    certificate : Certificate
    """

    of: dict[str, str]
    certificate: Certificate


# MessagePack and not JSON, which has no infinity.
_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(CertificateFile, dec_hook=decoded_part)


@lru_cache(maxsize=16)
def fallback_certificate(servo: Plant, uncertainty: Uncertainty, demands: Demands, trial: Trial) -> Certificate:
    """Return the certificate of the setting for all of the uncertainty: from the cache, or verified now.

    Raises
    ------
    InvalidInput
        No setting is verified: state a narrower range, or lower the demands.
    """

    def verify() -> Certificate:
        result = certify(servo, uncertainty, demands, trial)
        if isinstance(result, NotVerified):
            known = f"stated in [twin.uncertainty] or by default are {in_words(uncertainty, servo)}"
            verified = ways_out(servo, uncertainty, demands, trial)
            raise InvalidInput(f"no fallback set for the servo's stated range: {result.reason}; {known}; {verified}")
        return result

    values = {"servo": servo, "uncertainty": uncertainty, "demands": demands, "trial": replace(trial, threads=None)}
    return cached_certificate(dict(part for name, value in values.items() for part in flattened(name, value)), verify)


def cached_certificate(of: dict[str, str], compute: Callable[[], Certificate]) -> Certificate:
    """Read the certificate of these values from the user's cache, or compute it and write it there.

    Parameters
    ----------
    of : dict of str to str
        All values that the certificate depends on, by name and in full; code and libraries are added.
    compute : callable
        Its exceptions pass, and leave no file.
    """
    folder = cache_folder()
    if folder is None:
        return compute()
    try:
        of = {**of, **_environment()}
    except OSError:
        # Code that cannot be read has no digest.
        return compute()
    name = hashlib.sha256(repr(sorted(of.items())).encode()).hexdigest()
    path = folder / "certificates" / f"{name}{_SUFFIX}"
    found = _read(path, of)
    if found is not None:
        return found
    certificate = compute()
    # A folder that cannot be written to costs time, and nothing else.
    with suppress(OSError, InvalidInput):
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        _write(path, CertificateFile(of, certificate))
        _remove_oldest(path.parent)
    return certificate


def flattened(name: str, value: object) -> Iterator[tuple[str, str]]:
    """(dotted name, value in full) of everything in nested dataclasses."""
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from flattened(f"{name}.{field.name}", getattr(value, field.name))
    else:
        yield name, repr(value)


@cache
def _environment() -> dict[str, str]:
    """Code, libraries and processor: compiled sums are rounded as the processor's instructions allow."""
    libraries = {name: version(name) for name in ("numpy", "scipy", "numba", "llvmlite")}
    processor = f"{platform.machine()} {llvmlite.binding.get_host_cpu_name()}"
    return {"code": source_digest(), "python": platform.python_version(), "processor": processor, **libraries}


def _read(path: Path, of: dict[str, str]) -> Certificate | None:
    """Read a file; None: it is absent, damaged, or of other values."""
    try:
        with open(path, "rb", opener=_without_waiting) as file_object:
            if not _is_own(os.fstat(file_object.fileno())):
                return None
            data = file_object.read(_LARGEST + 1)
        if len(data) > _LARGEST or hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
            return None
        file = _decoder.decode(data[_DIGEST:])
    except (OSError, msgspec.MsgspecError, ValueError, RecursionError):
        return None
    return file.certificate if file.of == of else None


def _without_waiting(path: str, flags: int) -> int:
    """Open a pipe too at once."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _is_own(found: os.stat_result) -> bool:
    """True for a plain file of this user that nobody else may write to."""
    own = not hasattr(os, "geteuid") or found.st_uid == os.geteuid()
    return stat.S_ISREG(found.st_mode) and own and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _write(path: Path, file: CertificateFile) -> None:
    content = _encoder.encode(file)
    with atomic_output(path, mode=0o600) as temporary:
        temporary.write_bytes(hashlib.sha256(content).digest() + content)


def _remove_oldest(folder: Path) -> None:
    """Remove the oldest files beyond `MOST_FILES`; another process may do so too."""
    paths = list(folder.glob(f"*{_SUFFIX}"))
    if len(paths) > MOST_FILES:
        ages = {path: path.stat().st_mtime for path in paths}
        for path in sorted(paths, key=ages.__getitem__)[:-MOST_FILES]:
            path.unlink(missing_ok=True)
