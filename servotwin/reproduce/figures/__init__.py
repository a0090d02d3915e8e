"""The paper's figures and one of ours, one module each; `PLATES` lists them in the paper's order, ours last."""

from typing import Any

from servotwin.reproduce.figures import estimator, fig4, fig5, fig7, fig9, fig10b, fig11, fig12, fig15, fig16, figA1
from servotwin.reproduce.figures.plate import Plate

PLATES: tuple[Plate[Any], ...] = tuple(
    module.PLATE for module in (fig4, fig5, fig7, fig9, fig10b, fig11, fig12, fig15, fig16, figA1, estimator)
)

__all__ = ["PLATES", "Plate"]
