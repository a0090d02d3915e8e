"""Public measured data by name: fetched when it is asked for, checked, and kept in the user's cache; none is shipped.

The standard library is enough for one file over HTTPS with a checksum; pooch would bring three more packages into the
lock, and these hundred lines would stay: one sentence for each failure, the limit on the answer, the notice.
"""

from __future__ import annotations

import hashlib
import http.client
import io
import os
import urllib.request
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from servotwin.config.table import did_you_mean
from servotwin.errors import InvalidInput
from servotwin.runtime.files import replace_file
from servotwin.runtime.user_cache import VARIABLE, cache_folder

_TIMEOUT = 30.0  # s, without a byte
_SCHEMES = ("https://", "http://127.0.0.1:")


@dataclass(frozen=True)
class PublicDataset:
    """A set of measured data that others publish.

    Attributes
    ----------
    url : str
        Of the file, or of the ZIP archive that has it.
    file : str
        Name of the file; in an archive that of the member, with its folders or without.
    sha256 : str
        Of the file.
    largest : int
        Bytes; a longer answer is cut off and refused.
    source, notice : str
        Who published it, and what one may do with it.
    """

    url: str
    file: str
    sha256: str
    largest: int
    source: str
    notice: str


_UNTRIED = "The address was never tried here. The checksum is that of our copy"


def _bros(part: int, sha256: str) -> PublicDataset:
    """One of three parts of a recording of a planar robot's two joints, each with encoders at motor and joint."""
    return PublicDataset(
        url=(
            "https://raw.githubusercontent.com/niekbeckers/bi-robot-setup/939ba1d9f2f7f343ef5fd4880fa21891e496e7b5/"
            f"main-projects/data/transmission-ratio/meas-fm1/transmission_data_part{part}.mat"
        ),
        file=f"transmission_data_part{part}.mat",
        sha256=sha256,
        largest=2_000_000,
        source="N. Beckers, software and data of the robot BROS (github.com/niekbeckers/bi-robot-setup)",
        notice=f"published without a licence: for your own use, not to be passed on; cite the source. {_UNTRIED}",
    )


DATASETS: Mapping[str, PublicDataset] = {
    "emps": PublicDataset(
        url="https://drive.google.com/uc?export=download&id=1zwoXYa9-3f8NQ0ohzmjpF7UxbNgRTHkS",
        file="DATA_EMPS.mat",
        sha256="6cf6814ae14618795da0101aae2bb97ff0c6351b0501b5492751b02b07facf7e",
        largest=8_000_000,
        source=(
            "A. Janot, M. Gautier and M. Brunot, Data set and reference models of EMPS, Workshop on Nonlinear System "
            "Identification Benchmarks, 2019 (nonlinearbenchmark.org)"
        ),
        notice=(
            "published as a benchmark, no licence stated: for your own use, not to be passed on; cite the source. The "
            f"address is the one that public code names. {_UNTRIED}"
        ),
    ),
    "bros-1": _bros(1, "f4a2e15ea64330c1c3a8225636ab95bb9f7bdc05b0ce353d858ef730a5d8b809"),
    "bros-2": _bros(2, "ae9610f98a7a7249659f31b2e0719f1cd56a2748b5fc8fbc00946230e36cf2ed"),
    "bros-3": _bros(3, "be6cdfbea70335a7c91cc8a373e514f5d24bdc92802e73f8f895d5c71aed0261"),
}
"""By name."""


def fetch(name: str, folder: str | os.PathLike[str] | None = None) -> Path:
    """Return the file of a public set, which is fetched once.

    Parameters
    ----------
    name : str
        One of `DATASETS`.
    folder : path, optional
        Where files are kept; by default `datasets` in servotwin's folder of the user's cache.

    Raises
    ------
    InvalidInput
        There is no such set, it cannot be fetched, or what came is not the published file.
    """
    if name not in DATASETS:
        raise InvalidInput(
            f"dataset {name!r} does not exist{did_you_mean(name, DATASETS)}; give one of {', '.join(DATASETS)}"
        )
    known = DATASETS[name]
    path = _folder(name, folder) / known.file
    try:
        if path.is_file() and _digest(path.read_bytes()) == known.sha256:
            return path
    except OSError as error:
        raise InvalidInput(f"dataset {name}: {path}: cannot be read ({error.strerror})") from None
    content = _unpacked(name, known, _downloaded(name, known))
    if _digest(content) != known.sha256:
        raise InvalidInput(
            f"dataset {name}: what {known.url} sent is not the published file (SHA-256 {_digest(content)[:12]}..., "
            f"wanted {known.sha256[:12]}...); nothing was stored"
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, content)
    except OSError as error:
        raise InvalidInput(f"dataset {name}: {path}: cannot be written ({error.strerror})") from None
    return path


def _folder(name: str, folder: str | os.PathLike[str] | None) -> Path:
    if folder is not None:
        return Path(folder)
    cache = cache_folder()
    if cache is None:
        raise InvalidInput(f"dataset {name}: there is no cache folder; give a folder, or set {VARIABLE}")
    return cache / "datasets"


def _downloaded(name: str, known: PublicDataset) -> bytes:
    """The answer of the server, at most `largest` bytes."""
    if not known.url.startswith(_SCHEMES):
        raise InvalidInput(f"dataset {name}: {known.url}: must begin with https://")
    try:
        with urllib.request.urlopen(known.url, timeout=_TIMEOUT) as answer:
            content: bytes = answer.read(known.largest + 1)
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", None) or repr(error)
        raise InvalidInput(f"dataset {name}: cannot be fetched from {known.url} ({reason})") from None
    if len(content) > known.largest:
        raise InvalidInput(f"dataset {name}: {known.url} sent more than {known.largest} bytes; nothing was stored")
    return content


def _unpacked(name: str, known: PublicDataset, content: bytes) -> bytes:
    """The file, taken out of an archive where the answer is one."""
    if not zipfile.is_zipfile(io.BytesIO(content)):
        return content
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            member = next((each for each in archive.infolist() if Path(each.filename).name == known.file), None)
            if member is None or member.file_size > known.largest:
                raise InvalidInput(
                    f"dataset {name}: the archive of {known.url} has no {known.file} of at most {known.largest} bytes"
                )
            with archive.open(member) as file:
                return file.read(known.largest + 1)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError) as error:
        raise InvalidInput(f"dataset {name}: the archive of {known.url} cannot be read ({error})") from None


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
