"""Optional dependencies: the extra that installs each, and the error where one is missing."""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from typing import Any

from servotwin.errors import InvalidInput

EXTRAS = {
    "alembic": ("alembic", "twin"),
    "asammdf": ("asammdf", "mdf"),
    "asyncua": ("asyncua", "opcua"),
    "control": ("control", "interop"),
    "distributed": ("dask[distributed]", "dask"),
    "h5py": ("h5py", "hdf5"),
    "httptools": ("httptools", "twin"),
    "joblib": ("joblib", "maps"),
    "matplotlib": ("matplotlib", "plot"),
    "mcap": ("mcap", "mcap"),
    "nptdms": ("npTDMS", "tdms"),
    "paho": ("paho-mqtt", "mqtt"),
    "pandas": ("pandas", "pandas"),
    "psycopg": ("psycopg", "postgres"),
    "pyarrow": ("pyarrow", "parquet"),
    "sqlalchemy": ("sqlalchemy", "twin"),
    "uvicorn": ("uvicorn", "twin"),
    "zstandard": ("zstandard", "twin"),
}
"""Distribution and extra, by the name of the imported package."""


def require(module: str, purpose: str) -> Any:
    """Import an optional dependency.

    Parameters
    ----------
    module : str
        Dotted name of the module; its package is in `EXTRAS`.
    purpose : str
        Feature that needs it; the message begins with it.

    Returns
    -------
    module

    Raises
    ------
    InvalidInput
        The package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        # A dependency of the package may be what is missing: the same extra brings it.
        known = error.name is not None and error.name.partition(".")[0] in EXTRAS
        raise missing_extra(error.name if known and error.name else module, purpose) from None


def check_extra(module: str, purpose: str) -> None:
    """Check that an optional dependency is installed, without importing it.

    Raises
    ------
    InvalidInput
        The package is not installed.
    """
    if not _is_installed(module):
        raise missing_extra(module, purpose)


def missing_extra(module: str, purpose: str) -> InvalidInput:
    """Make the error for a package of `EXTRAS` that is not installed; it names the pip command.

    Parameters
    ----------
    module : str
        Dotted name of the module that could not be imported.
    purpose : str
        Feature that needs it.
    """
    package, extra = EXTRAS[module.partition(".")[0]]
    return InvalidInput(f"{purpose} needs {package}, which is not installed; give: pip install 'servotwin[{extra}]'")


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except (ModuleNotFoundError, ValueError):  # ValueError: sys.modules holds None for it
        return False
