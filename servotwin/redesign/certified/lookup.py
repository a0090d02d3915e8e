"""Settings verified beforehand, one for each cell of a grid over gap, input bias and noise.

A cell is an interval of gaps and a largest input bias that the feedforward leaves uncancelled; its setting was
verified on machines of the whole cell, so it serves every region inside. A region that no verified cell contains gets
the fallback set.
Cells of every width overlap by half, so that a region lies in one at most four times as wide, but for the narrowest.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NORMAL_95
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.messages import Setting
from servotwin.plant.basis import BacklashKind
from servotwin.plant.plants import Plant
from servotwin.plant.scales import scales
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.certified.certify import certify, confirm, known_bias
from servotwin.redesign.certified.learnt_servo import counts_learnt
from servotwin.redesign.certified.policy import CertifiedPolicy, alike
from servotwin.redesign.certified.uncertainty import Range, Region, Uncertainty
from servotwin.redesign.design import with_feedforward
from servotwin.redesign.policy import Evidence, Redesign

# Levels of width within which the running setting is preferred: a slightly cheaper one is not worth an update.
_PREFERRED_LEVELS = 2
# Of the smallest noise of the grid: less counts as none.
_QUIET = 10.0
# To the smallest step.
_NOISES = 10.0
# Of the stated range of gaps: width of the narrowest cells where none is given.
_FINEST = 1.0 / 16.0


@dataclass(frozen=True)
class Grid:
    """Grid of cells for which settings are verified.

    Parameters
    ----------
    finest : float
        rad, width of the narrowest cells; others are twice, four times ... as wide, up to the whole stated range.
    biases : tuple of float
        Unit of the command, rising: largest input bias that the feedforward leaves uncancelled.
    noises : tuple of float
        m (rotary: rad) rms, rising: noise for which candidates are ranked; the verification does not depend on it.

    Raises
    ------
    InvalidInput
        A value is not finite, not positive (a noise: negative), or they do not rise.
    """

    finest: float = math.radians(4.0)
    biases: tuple[float, ...] = (1e-3, 1e-2, 5e-2)
    noises: tuple[float, ...] = (0.0, 1e-5)

    def __post_init__(self) -> None:
        if not 0.0 < self.finest < math.inf:
            raise InvalidInput(f"table finest = {self.finest!r} rad: must be finite and above 0")
        for name, least in (("biases", 1e-300), ("noises", 0.0)):
            values = getattr(self, name)
            rising = all(a < b for a, b in itertools.pairwise(values))
            if not values or not rising or not (least <= values[0] and values[-1] < math.inf):
                raise InvalidInput(f"table {name} = {values!r} in SI units: must be finite, rising and not negative")

    @classmethod
    def of(
        cls,
        policy: CertifiedPolicy,
        finest: float | None = None,
        biases: tuple[float, ...] | None = None,
        noises: tuple[float, ...] | None = None,
    ) -> Grid:
        """Make a grid; a finest width that is left out is a sixteenth of the stated range of gaps.

        Noises that are left out are a part of the smallest step, biases in the servo's own volts, the largest at most
        half of the stated one.
        """
        usual, volt, known = cls(), scales(policy.servo).voltage, max(map(abs, policy.uncertainty.input_bias))
        least, most = policy.uncertainty.gap
        if known > 0.0:
            volt = min(volt, 0.5 * known / usual.biases[-1])
        return cls(
            (_FINEST * (most - least) or usual.finest) if finest is None else finest,
            tuple(volt * bias for bias in usual.biases) if biases is None else biases,
            (0.0, policy.uncertainty.step[0] / _NOISES) if noises is None else noises,
        )

    def levels(self, stated: Range) -> tuple[float, ...]:
        """rad: widths of cells, rising; the last is the whole stated range."""
        whole = stated[1] - stated[0]
        halvings = 0 if whole <= self.finest else math.ceil(math.log2(whole / self.finest) - 1e-9)
        return tuple(whole / 2.0**k for k in range(halvings, -1, -1))


class CellIndex(NamedTuple):
    """Index of a cell: places in the levels of width, along the gap in half widths, in the biases and in the noises."""

    level: int
    place: int
    bias: int
    noise: int


@dataclass(frozen=True)
class CertifiedTable:
    """Certificates of the cells of a grid.

    Attributes
    ----------
    grid : Grid
    stated : (float, float)
        rad: range of gaps.
    friction : (float, float)
        N m.
    feedforward_limit : float
        V, either sign.
    bias_known : float
        V: for a bias up to this the policy bounds the overshoot, and only cells up to this are verified for that.
    fallback : Certificate
        Certificate of the fallback set, which serves the whole stated range.
    cells : dict of CellIndex to Certificate or None
        None: no setting was verified there.
    """

    grid: Grid
    stated: Range
    friction: Range
    feedforward_limit: float
    bias_known: float
    fallback: Certificate
    cells: dict[CellIndex, Certificate | None]

    def find(self, region: Region, running: Setting | None = None) -> Certificate | NotVerified:
        """Find the certificate of the narrowest verified cell that contains a region, with the region's feedforward.

        A cell up to four times as wide is preferred if its setting, but for the feedforwards, is `running` already.
        """
        if region.friction[0] < self.friction[0] or region.friction[1] > self.friction[1]:
            return NotVerified(f"friction of up to {region.friction[1]:.3g} N m is in no cell of the table")
        if abs(region.feedforward) > self.feedforward_limit:
            return NotVerified(f"a feedforward of {region.feedforward:.3g} V is in no cell of the table")
        cells = [(key, self.cells.get(key)) for key in self._containing(region)]
        verified = [(key, certificate) for key, certificate in cells if certificate is not None]
        if verified:
            widest = verified[0][0].level + _PREFERRED_LEVELS
            same = [one for key, one in verified if key.level <= widest and alike(one.setting, running)]
            return (same or [verified[0][1]])[0].fed(region.feedforward)
        low, high = (math.degrees(end) for end in region.gap)
        bias = 1e3 * region.largest_bias
        return NotVerified(
            f"no verified cell of the table holds gaps of {low:.4g} to {high:.4g} deg with {bias:.3g} mV of bias"
        )

    def _containing(self, region: Region) -> Iterator[CellIndex]:
        """Cells that contain a region, the smallest bias first, then the narrowest."""
        low, high = region.gap
        noise = self._noise(region.noise)
        wide = enumerate(self.grid.levels(self.stated))
        places = [CellIndex(level, self._place(low, width), 0, noise) for level, width in wide]
        containing = [key for key in places if _contains(cell_range(self.grid, self.stated, key), low, high)]
        known = region.largest_bias <= self.bias_known
        for bias, limit in enumerate(self.grid.biases):
            if region.largest_bias <= limit and (limit <= self.bias_known) == known:
                yield from (key._replace(bias=bias) for key in containing)

    def _place(self, low: float, width: float) -> int:
        """Place of the highest cell of a width that does not begin above `low`."""
        most = 2 * round((self.stated[1] - self.stated[0]) / width) - 2 if width > 0.0 else 0
        if most <= 0:
            return 0
        return min(max(0, math.floor((low - self.stated[0]) / (0.5 * width))), most)

    def _noise(self, noise: float) -> int:
        """Index of the nearest noise of the grid, by ratio."""
        quiet = min((level for level in self.grid.noises if level > 0.0), default=1.0) / _QUIET
        distances = [abs(math.log((level + quiet) / (noise + quiet))) for level in self.grid.noises]
        return distances.index(min(distances))


def cells_of(grid: Grid, stated: Range) -> Iterator[CellIndex]:
    """List all cells, the widest first."""
    widths = grid.levels(stated)
    for level in reversed(range(len(widths))):
        count = 1 if level == len(widths) - 1 else 2 * round((stated[1] - stated[0]) / widths[level]) - 1
        for place in range(count):
            for bias in range(len(grid.biases)):
                for noise in range(len(grid.noises)):
                    yield CellIndex(level, place, bias, noise)


def cell_range(grid: Grid, stated: Range, key: CellIndex) -> Range:
    """rad: the gaps of a cell."""
    width = grid.levels(stated)[key.level]
    low = stated[0] + 0.5 * width * key.place
    return low, min(low + width, stated[1])


def certify_cell(policy: CertifiedPolicy, grid: Grid, key: CellIndex) -> Certificate | None:
    """Certify the setting of a cell; None where none is verified.

    As long as no voltage meets its limit, the feedforward matters only through the bias that it leaves. So the cell is
    verified without feedforward, and with a limit that is lower by the largest one. Where that limit is met, it is
    verified with the limit itself, without feedforward and with the largest one either way. Every machine has to
    settle: the few that need not might all lie in the region that is looked up.
    """
    bias, limit = grid.biases[key.bias], policy.servo.controller.voltage_limit
    known = policy.uncertainty.replace(gap=cell_range(grid, policy.uncertainty.gap, key), input_bias=(-bias, bias))
    lower = policy.servo if limit is None else policy.servo.replace(voltage_limit=limit - policy.feedforward_limit)
    noise, demands = grid.noises[key.noise], replace(policy.demands_within_band(), failures=0)
    found = certify(lower, known, demands, policy.simulations, 0.0, noise, policy.clock)
    if isinstance(found, Certificate) and found.saturated:
        found = certify(policy.servo, known, demands, policy.simulations, 0.0, noise, policy.clock)
        if isinstance(found, Certificate):
            found = _with_feedforwards(policy, known, found, noise)
    if isinstance(found, NotVerified) or found.settled < 1.0:
        return None
    law = found.setting.controller.replace(voltage_limit=limit)
    return replace(found, setting=replace(found.setting, controller=law))


def _with_feedforwards(
    policy: CertifiedPolicy, known: Uncertainty, found: Certificate, noise: float
) -> Certificate | NotVerified:
    """Certificate whose worst effort and settling are those with the largest feedforwards, too, limits included."""
    (low, high), most = known.input_bias, policy.feedforward_limit
    demands = replace(policy.demands_within_band(), failures=0)
    worst = found
    for feedforward in (-most, most) if most else ():
        biased = known.replace(input_bias=(low - feedforward, high - feedforward))
        fed = with_feedforward(found.setting, feedforward)
        tried = confirm(policy.servo, biased, fed, demands, policy.simulations, noise, policy.clock)
        if isinstance(tried, NotVerified):
            return tried
        if tried.settled < 1.0:
            return NotVerified(f"with a feedforward of {feedforward:.3g} V not every machine settles", tried)
        worst = replace(
            worst,
            effort=max(worst.effort, tried.effort),
            settling_worst=max(worst.settling_worst, tried.settling_worst),
        )
    return worst


def table_of(policy: CertifiedPolicy, grid: Grid, cells: dict[CellIndex, Certificate | None]) -> CertifiedTable:
    """Table of the certificates of a policy."""
    known = policy.uncertainty
    least = known_bias(policy.servo, known, policy.demands)
    return CertifiedTable(grid, known.gap, known.friction, policy.feedforward_limit, least, policy.fallback(), cells)


@dataclass(frozen=True)
class TablePolicy:
    """The certified policy with its certificates looked up; a redesign carries the certificate of a cell.

    Parameters
    ----------
    policy : CertifiedPolicy
    table : CertifiedTable
    """

    policy: CertifiedPolicy
    table: CertifiedTable
    needs_estimate: ClassVar[bool] = False
    provisional: ClassVar[bool] = True

    def redesign(self, evidence: Evidence) -> Redesign:
        """Choose the setting of a cell that contains all machines that the evidence allows; else the fallback set.

        A machine that was learnt to lie outside of the stated half-widths is in no cell: its settings are verified.
        """
        servo, learnt, known = self.policy.servo, evidence.machine, self.policy.uncertainty
        if learnt is not None and counts_learnt(servo, learnt, known) and not _is_stated(servo, learnt, known):
            return self.policy.redesign(evidence)
        return self.policy.decide(evidence, self)

    def asked(self, _region: Region) -> None:
        """None: a table makes no search."""

    def verify(self, region: Region, running: Setting | None) -> Certificate | NotVerified:
        """Look up the certificate for a region."""
        return self.table.find(region, running)

    def fallback(self) -> Certificate:
        """Certificate of the fallback set."""
        return self.table.fallback

    def withdrawn(self, evidence: Evidence, why: str) -> Redesign:
        """Decide for the fallback set, whatever the table holds."""
        return self.policy.decide(evidence, _WithdrawnTable(self.table.fallback, why))


@dataclass(frozen=True)
class _WithdrawnTable:
    """A withdrawn table: it has the fallback set only."""

    certificate: Certificate
    why: str
    provisional: ClassVar[bool] = False

    def asked(self, _region: Region) -> None:
        return None

    def verify(self, _region: Region, _running: Setting | None) -> NotVerified:
        return NotVerified(self.why)

    def fallback(self) -> Certificate:
        return self.certificate


def _is_stated(servo: Plant, machine: FactorPrior, known: Uncertainty) -> bool:
    """True where stiffness and damping over the masses, as learnt, lie within what the half-widths allow.

    Of a free shaft the stiffness alone counts.
    """
    count = 1 if servo.backlash_kind is BacklashKind.FREE else 2
    spread = NORMAL_95 * np.sqrt(np.diag(machine.covariance)[:count])
    low, high = np.exp(machine.mean[:count] - spread), np.exp(machine.mean[:count] + spread)
    widths = np.array([known.k, known.c])[:count]
    return bool(np.all((1.0 - widths) / (1.0 + known.m) <= low) and np.all(high <= (1.0 + widths) / (1.0 - known.m)))


def _contains(cell: Range, low: float, high: float) -> bool:
    return cell[0] <= low and high <= cell[1]
