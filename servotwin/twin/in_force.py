"""Settings at the edge, by version, as far as this twin knows them."""

from __future__ import annotations

from dataclasses import dataclass, field

from msgspec.structs import replace

from servotwin.messages import Fallback, Hello, Setting, Update

NEWEST = 16
"""Versions that are remembered, beside what the edge starts with and what runs there."""


@dataclass
class Settings:
    """The setting of each version of the parameters, the newest of them.

    Attributes
    ----------
    by_version : dict of int to Setting
    """

    by_version: dict[int, Setting] = field(default_factory=dict)

    def of(self, version: int) -> Setting | None:
        """Setting of a version; None: not known."""
        return self.by_version.get(version)

    def issue(self, update: Update, in_force: int) -> None:
        """Note what an update sets; without gains those of its base stay, and what is in force is not forgotten."""
        self._note(update.version, self.of(update.base_version), update.setting, in_force)

    def fall_back(self, message: Fallback) -> None:
        """Note what the edge has set by itself."""
        self._note(message.parameter_version, self.of(message.replaced), message.setting)

    def hear(self, message: Hello) -> None:
        """Note what the edge says it runs: after a restart, that may be a setting that it stored in an earlier boot."""
        self._note(message.parameter_version, self.of(message.parameter_version), message.setting)

    def _note(self, version: int, base: Setting | None, setting: Setting, needed: int = 0) -> None:
        if setting.gains is None and base is not None:
            setting = replace(setting, gains=base.gains)
        self.by_version[version] = setting
        keep = {0, version, needed, *sorted(self.by_version)[-NEWEST:]}
        self.by_version = {known: runs for known, runs in self.by_version.items() if known in keep}
