"""Context of an estimate: versions, model and settings under which it was computed, as text under its digest.

Equal window, prior and context give an equal estimate, bit for bit. Under another one it
need not: then the parts that differ are named. Model and settings can be made again from the text.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import platform
import re
from collections.abc import Mapping
from functools import lru_cache
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import msgspec

import servotwin
from servotwin.errors import InvalidInput
from servotwin.estimation.gap import METHODS
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.fallback import flattened
from servotwin.twin.settings import TwinSettings

SOURCES = ("control", "estimation", "hybrid", "messages", "plant", "redesign", "simulation", "twin")
"""Packages on which an estimate or a redesign may depend; each has a digest of its own."""
LIBRARIES = ("numpy", "scipy", "numba", "llvmlite")
_BLAS = ("OPENBLAS_NUM_THREADS", "OPENBLAS_CORETYPE", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_MODEL, _SETTINGS = "model", "settings"
# The file of an axis, instead of the values of a servo.
_AXIS = f"{_MODEL}.axis"
_INFINITE = re.compile(r"\binf\b(?!')")


@lru_cache(maxsize=256)
def context_of(servo: Plant, settings: TwinSettings) -> tuple[str, str]:
    """(digest, JSON) of the context of a model and its settings in this process.

    The JSON is one object of texts: the name of each part, and its value in full.
    """
    model = {_AXIS: repr(servo.dumps())} if isinstance(servo, Axis) else dict(flattened(_MODEL, servo))
    parts = {**environment(), **model, **dict(flattened(_SETTINGS, settings))}
    text = json.dumps(parts, sort_keys=True, indent=0)
    return hashlib.sha256(text.encode()).hexdigest()[:32], text


def parts_of(context: str) -> dict[str, str]:
    """The parts of a context's JSON.

    Raises
    ------
    InvalidInput
        The text is not the JSON of a context.
    """
    try:
        return msgspec.json.decode(context, type=dict[str, str])
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidInput(f"the context is not understood: {error}") from None


def differences(then: Mapping[str, str], now: Mapping[str, str]) -> tuple[str, ...]:
    """Parts in which two contexts differ, each with both values."""
    keys = (key for key in sorted({*then, *now}) if then.get(key) != now.get(key))
    return tuple(f"{key} {then.get(key, 'unknown')} then, {now.get(key, 'unknown')} now" for key in keys)


def described(parts: Mapping[str, str]) -> tuple[Plant, TwinSettings]:
    """Return the model and the settings that a context's parts describe.

    Raises
    ------
    InvalidInput
        This version cannot read them.
    """
    try:
        servo: Plant
        if _AXIS in parts:
            servo = Axis.loads(ast.literal_eval(parts[_AXIS]), "the context's model")
        else:
            servo = msgspec.convert(_nested(parts, _MODEL), Servo)
        values = {
            "learning": {"learn": False},
            **_nested(parts, _SETTINGS),
        }  # versions without this part learnt nothing
        estimator = values.pop("estimator", None)
        if estimator is not None:
            estimator = msgspec.convert(estimator, METHODS[values["method"]].settings)
        return servo, msgspec.convert(values, TwinSettings).replace(estimator=estimator)
    except (
        msgspec.MsgspecError,
        ValueError,
        SyntaxError,
        LookupError,
        TypeError,
        AttributeError,
        RecursionError,
    ) as error:
        raise InvalidInput(f"the context's model or settings are not understood: {error}") from None


@lru_cache(maxsize=1)
def environment() -> Mapping[str, str]:
    """Versions, sources and machine of this process; the last decides in which order sums of floats are taken."""
    processor = import_module("llvmlite.binding").get_host_cpu_name()
    return {
        "servotwin": servotwin.__version__,
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in LIBRARIES},
        **{f"source {package}": _source(package) for package in SOURCES},
        "processor": f"{platform.machine()} {processor}",
        "blas": ", ".join(f"{name}={os.environ[name]}" for name in _BLAS if name in os.environ) or "as it comes",
    }


def _source(package: str) -> str:
    """Digest of a package's source, so that an edit shows that no version tells."""
    root = Path(servotwin.__file__).parent
    total = hashlib.sha256()
    for path in sorted((root / package).rglob("*.py")):
        total.update(f"{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return total.hexdigest()[:16]


def _nested(parts: Mapping[str, str], name: str) -> dict[str, Any]:
    """The values under a name, as nested as they were."""
    top: dict[str, Any] = {}
    for key, text in parts.items():
        if key.startswith(f"{name}."):
            *between, last = key.split(".")[1:]
            place = top
            for step in between:
                place = place.setdefault(step, {})
            place[last] = ast.literal_eval(_INFINITE.sub("1e999", text))
    return top
