"""Linear law in the file of an axis: its matrices row by row, or a file with those of a system."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from servotwin.config.keys import key
from servotwin.config.named_file import check_named
from servotwin.config.table import did_you_mean
from servotwin.control import law_keys
from servotwin.control import linear_law_file as keys
from servotwin.control.linear_law import LOAD, LinearLaw
from servotwin.errors import InvalidInput
from servotwin.plant.signals import Array

_LARGEST_FILE = 1_000_000  # bytes: a law of more than 300 states has no place in a loop
_SUFFIXES = (".npz", ".mat")


class _System(NamedTuple):
    """Matrices of a file, and their sample time (s) where they are discrete."""

    A: Array
    B: Array
    C: Array
    D: Array
    dt: float | None


def linear_law(
    system: Annotated[
        Path | None,
        key(
            help="Instead of A, B, C and D: NAME.npz or NAME.mat with them, and dt in s where they are discrete; of "
            "one input (the error), two (reference and the measurement that `on` names) or three."
        ),
    ] = None,
    A: keys.StateRows = (),
    B: keys.InputRows = (),
    C: keys.StateGains = (),
    D: keys.InputGains = (),
    sample_rate: law_keys.SampleRate = None,
    discrete: keys.Discrete = False,
    names: keys.StateNames = (),
    on: keys.Measured = LOAD,
    ratio: keys.Travel = None,
    enter: keys.Enter = 1.0,
    leave: keys.Leave = 1.0,
    holds: keys.Holds = (),
    integral_only: keys.IntegralOnly = True,
    voltage_limit: law_keys.VoltageLimit = None,
    rate_limit: law_keys.RateLimit = None,
    windup: keys.Windup = (),
    feedforward: keys.Feedforward = 0.0,
    release_time: law_keys.ReleaseTime = None,
    gain: keys.Gain = 1.0,
    integral_share: keys.IntegralShare = 1.0,
    B_inside: keys.InsideRows = (),
    D_inside: keys.InsideGains = (),
) -> LinearLaw:
    """Any linear law of reference, y_motor and y_load."""
    rest: dict[str, Any] = {
        "names": names, "enter": enter, "leave": leave, "holds": holds, "integral_only": integral_only,
        "voltage_limit": voltage_limit, "rate_limit": rate_limit, "windup": windup, "feedforward": feedforward,
        "release_time": release_time, "gain": gain, "integral_share": integral_share,
        "B_inside": B_inside, "D_inside": D_inside,
    }  # fmt: skip
    if system is None:
        if not D:
            raise InvalidInput("law D: is missing; give A, B, C and D, or system with the path of a .npz or .mat")
        return keys.matrices_law(A, B, C, D, sample_rate, discrete, on=on, ratio=ratio, **rest)
    if A or B or C or D or discrete:
        raise InvalidInput(f"law system = {system}: brings A, B, C, D and dt; leave A, B, C, D and discrete out")
    if sample_rate is not None:
        rest["sample_rate"] = sample_rate
    return LinearLaw.from_system(_read_system(system), on, 1.0 if ratio is None else ratio, **rest)


def _read_system(path: Path) -> _System:
    """Read the matrices of a system.

    Raises
    ------
    InvalidInput
        The file cannot be read, or holds no such matrices.
    """
    if path.suffix not in _SUFFIXES:
        raise InvalidInput(f"law system = {path}: must be a .npz or a .mat")
    arrays = _arrays(path)
    for name in ("A", "B", "C", "D"):
        if name not in arrays:
            found = ", ".join(arrays) or "nothing"
            raise InvalidInput(f"law system = {path}: has no {name}{did_you_mean(name, arrays)}; it has {found}")
    A, B, C, D = (_matrix(path, name, arrays[name]) for name in "ABCD")
    if A.size == 0:
        A, B, C = np.zeros((0, 0)), np.zeros((0, D.shape[1])), np.zeros((1, 0))
    return _System(A, B, C, D, _sample_time(path, arrays.get("dt", 0.0)))


def _matrix(path: Path, name: str, given: Any) -> Array:
    values = np.asarray(given)
    if values.ndim > 2 or not (np.issubdtype(values.dtype, np.floating) or np.issubdtype(values.dtype, np.integer)):
        raise InvalidInput(
            f"law system = {path}: {name} has {values.ndim} dimensions of {values.dtype}; "
            "it must be a matrix of real numbers"
        )
    return np.atleast_2d(values.astype(float))


def _sample_time(path: Path, given: Any) -> float | None:
    """Sample time, s; None: continuous, which a dt of 0 stands for."""
    values = np.asarray(given)
    # True is python-control's "discrete, at a rate that nobody stated".
    real = np.issubdtype(values.dtype, np.floating) or np.issubdtype(values.dtype, np.integer)
    if values.size != 1 or not real or not 0.0 <= float(values.item()) < np.inf:
        raise InvalidInput(
            f"law system = {path}: dt = {given!r}: must be the sample time in s, or 0 of a continuous system"
        )
    return float(values.item()) or None


def _arrays(path: Path) -> Mapping[str, Any]:
    check_named(path, "law system = ")
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise InvalidInput(f"law system = {path}: has more than {_LARGEST_FILE} bytes; give the matrices alone")
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                return dict(file)
        return _mat_arrays(path)
    except OSError as error:
        raise InvalidInput(f"law system = {path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, NotImplementedError, zipfile.BadZipFile, EOFError) as error:
        raise InvalidInput(f"law system = {path}: is no {path.suffix} file of matrices ({error})") from None


def _mat_arrays(path: Path) -> Mapping[str, Any]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        return {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
    except (MatReadError, TypeError) as error:  # TypeError: what damaged files of MATLAB 5 end in
        raise ValueError(error) from None
