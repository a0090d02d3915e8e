"""The paper's figures in its order, then ours; `PLATES` lists them."""

from typing import Any

from servotwin.reproduction.figures import (
    estimator,
    fig4,
    fig5,
    fig7,
    fig9,
    fig10b,
    fig11,
    fig12,
    fig15,
    fig16,
    figA1,
    policies,
)
from servotwin.reproduction.figures.plate import Plate

OURS: tuple[Plate[Any], ...] = (estimator.PLATE, *policies.PLATES)
PLATES: tuple[Plate[Any], ...] = (
    *(module.PLATE for module in (fig4, fig5, fig7, fig9, fig10b, fig11, fig12, fig15, fig16, figA1)),
    *OURS,
)

__all__ = ["OURS", "PLATES", "Plate"]
