"""Registry of models: model and settings of the twin of each servo; many servos share one model.

In a file::

    [models.axis]
    servo = "paper"                 # a preset, or a servo's TOML relative to this file
    [models.axis.controller]        # changes of the servo's own controller
    ki_v_per_m_s = 0.0
    [models.axis.twin]              # keys as in a scenario's [twin]
    policy = "certified"

    [servos]
    "ax-1" = "axis"                 # one servo
    "line-*" = "axis"               # all names with this beginning; the first match counts

A `ModelRegistry` is a frozen, small value, which is quickly made. It can be pickled to a pool's workers at their start
(it belongs to the service and never crossed a link), or read there from the same text. Each process computes the slow
parts of a model, mainly the certified fallback set, at the first use, and caches them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Annotated

from servotwin.config.table import Table, did_you_mean, named, parse_toml, read_inner
from servotwin.config.toml import changes, made, read
from servotwin.control.gains import gains_of
from servotwin.control.laws import AnyController
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.messages import NAME_PATTERN, Setting
from servotwin.plant.own_units import own_units
from servotwin.plant.plants import PLANT_KEY, Plant
from servotwin.redesign.policy import Policy
from servotwin.redesign.registry import certified_policy, policy_of
from servotwin.twin.estimating import Estimator, estimator_of
from servotwin.twin.model import TwinModel
from servotwin.twin.servo_names import ServoNames
from servotwin.twin.settings import TwinSettings, read_twin_settings

MAX_MODELS = 256


@dataclass(frozen=True)
class ServoModel:
    """Model and settings of the twins of equal servos.

    Attributes
    ----------
    name : str
    servo : Servo or Axis
        The model, with the controller that runs.
    settings : TwinSettings
    start : Setting or None
        Setting of the edge before the first update, where the hello of the edge does not state it. None: the fallback
        set certified for the whole stated range, with which an edge under the policy "certified" begins; it is
        computed at the first use, which takes seconds.
    """

    name: str
    servo: Plant
    settings: TwinSettings
    start: Setting | None = None

    @property
    def first_setting(self) -> Setting | None:
        """Return `start`, or the certified fallback set; None where none is verified for the whole stated range."""
        return _certified_start(self) if self.start is None else self.start

    def twin(self, restored: bool) -> TwinModel:
        """Make the model of the twins; estimator and policy are made once per process.

        Parameters
        ----------
        restored : bool
            True for a twin that continues from a state, which does not need `start`.

        Raises
        ------
        InvalidInput
            The policy cannot design for the controller.
        """
        return _twin_model(self, self.start if restored else self.first_setting)


@dataclass(frozen=True)
class ModelRegistry:
    """The models, and which of them each servo has.

    Parameters
    ----------
    models : tuple of ServoModel
        Their names are unique.
    servos : tuple of (str, str)
        (name of a servo, or a pattern with *, name of its model).

    Raises
    ------
    InvalidInput
        A name is not allowed or occurs twice, or a model does not exist.
    """

    models: tuple[ServoModel, ...]
    servos: tuple[tuple[str, str], ...]

    def __post_init__(self) -> None:
        if len(self._by_name) < len(self.models) or not 1 <= len(self.models) <= MAX_MODELS:
            raise InvalidInput(f"fleet: has {len(self.models)} models: must be 1 to {MAX_MODELS} with different names")
        for servo, model in self._names.servos:
            if model not in self._by_name:
                hint = did_you_mean(model, self._by_name)
                raise InvalidInput(f"servos.{servo} = {model!r}: there is no such model{hint}")

    @classmethod
    def read(cls, table: Table, folder: Path) -> ModelRegistry:
        """Read [models] and [servos] of a twin's file; paths are relative to `folder`.

        The caller reads the other keys of the table before `table.done()`.

        Raises
        ------
        InvalidInput
            A key is unknown or missing, a value is not allowed, a file that it names cannot be read, a controller is
            unstable on its servo even without a gap.
        """
        models = models_of(table, folder)
        names = ServoNames.read(table)
        with named(table):
            return cls(models, names.servos)

    @classmethod
    def loads(cls, text: str, source: str, folder: Path) -> ModelRegistry:
        """Read the text of a file, whose name in messages is `source`; its other tables are ignored."""
        return cls.read(parse_toml(text, source), folder)

    def model_of(self, servo: str) -> ServoModel:
        """Return the model of a servo.

        Raises
        ------
        InvalidInput
            The servo has no model.
        """
        model = self._names.model_of(servo)
        if model is None:
            raise InvalidInput(f"servo {servo!r} has no model: [servos] has neither its name nor a pattern that fits")
        return self._by_name[model]

    @cached_property
    def _by_name(self) -> dict[str, ServoModel]:
        return {model.name: model for model in self.models}

    @cached_property
    def _names(self) -> ServoNames:
        return ServoNames(self.servos)


def models_of(table: Table, folder: Path, checked: bool = True) -> tuple[ServoModel, ...]:
    """Read [models] of a twin's file; where not `checked`, values that a policy needs may be missing."""
    inner = table.table("models", required=True)
    make = partial(_model, folder=folder, checked=checked)
    return tuple(read_inner(inner, name, partial(make, name=name)) for name in inner.values)


def _model(table: Table, name: str, folder: Path, checked: bool) -> ServoModel:
    """Read one table of [models]."""
    if not re.match(NAME_PATTERN, name):
        raise InvalidInput(f"{name!r} is not a name of a model: 1 to 64 of A-Z a-z 0-9 . _ - are allowed")
    servo: Plant = read(table, servo_table, folder)
    table = table.in_units(own_units(servo), servo.p)
    inner = table.table("controller")
    with named(inner):
        law = _changed(inner, servo.controller)
    inner.done()
    settings = read_inner(table, "twin", partial(read_twin_settings, folder=folder, plant=servo))
    servo.check_loop(law)
    own = gains_of(law) == gains_of(servo.controller)
    if checked:
        policy_of(servo.replace(controller=law), settings)
    return ServoModel(name, servo.replace(controller=law), settings, _start(servo, law, settings, own))


def servo_table(servo: Annotated[Plant, PLANT_KEY]) -> Plant:
    """Return the servo that a model names."""
    return servo


def _changed(table: Table, controller: AnyController) -> AnyController:
    """The controller with the changes of a table; a linear law has no keys."""
    if isinstance(controller, LinearLaw):
        return controller
    kind = type(controller)
    changed: AnyController = made(table, kind, controller.replace, changes(table, kind))
    return changed


def _start(servo: Plant, law: AnyController, settings: TwinSettings, own: bool) -> Setting | None:
    """Setting with which an edge begins, as in `Commissioning.start`; `own`: the gains are the servo's own."""
    if settings.policy == "certified":
        return None if own else Setting.of(0.0, gains_of(law))
    return Setting.of(settings.initial_tolerance(servo), gains_of(law))


@lru_cache(maxsize=2 * MAX_MODELS)
def _twin_model(model: ServoModel, start: Setting | None) -> TwinModel:
    return TwinModel.of(model.servo, model.settings, start=start, estimator=_estimator(model), policy=_policy(model))


@lru_cache(maxsize=MAX_MODELS)
def _estimator(model: ServoModel) -> Estimator:
    return estimator_of(model.servo, model.settings)


@lru_cache(maxsize=MAX_MODELS)
def _policy(model: ServoModel) -> Policy:
    return policy_of(model.servo, model.settings)


@lru_cache(maxsize=MAX_MODELS)
def _certified_start(model: ServoModel) -> Setting | None:
    try:
        return certified_policy(model.servo, model.settings).fallback().setting.setting()
    except InvalidInput:
        return None
