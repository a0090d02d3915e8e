"""What runs at the edge, as far as this twin was told."""

from __future__ import annotations

from dataclasses import dataclass, field

from servotwin.control.controller import Controller
from servotwin.control.gains import with_gains
from servotwin.messages import Fallback, Gains, Update


@dataclass(frozen=True)
class InForce:
    """Controller and dead zone of one version; None: not known."""

    controller: Controller | None = None
    tolerance: float | None = None


@dataclass
class Settings:
    """What each version of the parameters set.

    Attributes
    ----------
    by_version : dict of int to InForce
    """

    by_version: dict[int, InForce] = field(default_factory=dict)

    def of(self, version: int) -> InForce:
        """Of a version; nothing of one that this twin never heard of."""
        return self.by_version.get(version, InForce())

    def issue(self, update: Update) -> None:
        """Note what an update sets; without gains those of its base stay."""
        base = self.of(update.base_version).controller
        self.by_version[update.version] = InForce(_changed(base, update.controller), update.tolerance)

    def fall_back(self, message: Fallback) -> None:
        """Note what the edge has set by itself."""
        base = self.of(message.replaced).controller
        self.by_version[message.parameter_version] = InForce(_changed(base, message.controller), message.tolerance)


def _changed(base: Controller | None, gains: Gains | None) -> Controller | None:
    return base and with_gains(base, gains)
