"""Optional dependencies: the one place that says how to install one that is missing."""

from __future__ import annotations

import importlib
from typing import Any

from servotwin.errors import InvalidInput


def require(module: str, extra: str, purpose: str) -> Any:
    """Import an optional dependency.

    Parameters
    ----------
    module : str
        Dotted name of the module.
    extra : str
        Extra of servotwin that installs it.
    purpose : str
        Feature that needs it; the message begins with it.

    Returns
    -------
    module

    Raises
    ------
    InvalidInput
        The module is not installed; the sentence names the pip command.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise missing(error.name or module, extra, purpose) from None


def missing(package: str, extra: str, purpose: str) -> InvalidInput:
    """Error for a package that is not installed."""
    package = {"paho": "paho-mqtt", "sqlalchemy": "SQLAlchemy"}.get(
        package.partition(".")[0], package.partition(".")[0]
    )
    return InvalidInput(f"{purpose} needs {package}, which is not installed; give: pip install 'servotwin[{extra}]'")
