"""What runs at the edge, as far as this twin was told."""

from __future__ import annotations

from dataclasses import dataclass, field

from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of, with_gains
from servotwin.messages import Fallback, Gains, Hello, Update
from servotwin.redesign.setting import Setting

NEWEST = 16
"""Versions that are remembered, beside what the edge starts with and what runs there."""


@dataclass(frozen=True)
class InForce:
    """Controller and dead zone of one version; None: not known."""

    controller: Controller | None = None
    tolerance: float | None = None

    def has(self, setting: Setting) -> bool:
        """Whether it is a setting's gains and dead zone."""
        same = self.controller is not None and gains_of(self.controller) == gains_of(setting.controller)
        return same and self.tolerance == setting.tolerance


@dataclass
class Settings:
    """What each version of the parameters set, the newest of them.

    Attributes
    ----------
    by_version : dict of int to InForce
    """

    by_version: dict[int, InForce] = field(default_factory=dict)

    def of(self, version: int) -> InForce:
        """Of a version; nothing of one that this twin never heard of."""
        return self.by_version.get(version, InForce())

    def issue(self, update: Update, in_force: int) -> None:
        """Note what an update sets; without gains those of its base stay, and what is in force is not forgotten."""
        base = self.of(update.base_version).controller
        self._note(update.version, base, update.controller, update.tolerance, in_force)

    def fall_back(self, message: Fallback) -> None:
        """Note what the edge has set by itself."""
        base = self.of(message.replaced).controller
        self._note(message.parameter_version, base, message.controller, message.tolerance)

    def hear(self, message: Hello) -> None:
        """Note what the edge says it runs: after a restart, that may be what was proved there in an earlier boot."""
        version = message.parameter_version
        base = self.of(version).controller or self.of(0).controller
        told = base if message.controller is not None else self.of(version).controller
        self._note(version, told, message.controller, message.tolerance)

    def _note(
        self, version: int, base: Controller | None, gains: Gains | None, tolerance: float, needed: int = 0
    ) -> None:
        self.by_version[version] = InForce(base and with_gains(base, gains), tolerance)
        keep = {0, version, needed, *sorted(self.by_version)[-NEWEST:]}
        self.by_version = {known: runs for known, runs in self.by_version.items() if known in keep}
