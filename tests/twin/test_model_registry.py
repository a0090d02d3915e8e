"""Which servo has which model: names first, then patterns, in the order of the file."""

import math
import pickle
from pathlib import Path

import pytest

from servotwin.config.table import parse_toml
from servotwin.control.gains import gains_of
from servotwin.cosim.scenario import Scenario
from servotwin.errors import InvalidInput
from servotwin.messages import Setting
from servotwin.plant.axis import AXES, Axis
from servotwin.plant.scales import scales
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.twin.model_registry import ModelRegistry, ServoModel, models_of
from servotwin.twin.settings import TwinSettings

TEXT = """
[models.plain]
servo = "paper"
[models.plain.twin]
policy = "paper"
initial_gap_deg = 1.0

[models.calm]
servo = "{servo}"
[models.calm.controller]
ki_v_per_m_s = 0.0
[models.calm.twin]
policy = "certified"

[servos]
"line-*" = "plain"
"line-7" = "calm"
"*-7" = "calm"
"""


def read(text: str = TEXT, folder: Path = Path(), servo: str = "paper") -> ModelRegistry:
    return ModelRegistry.loads(text.replace("{servo}", servo), "twin.toml", folder)


@pytest.mark.parametrize(
    ("servo", "model"), [("line-1", "plain"), ("line-7", "calm"), ("line-77", "plain"), ("mill-7", "calm")]
)
def test_a_name_goes_before_patterns_and_the_first_pattern_counts(servo, model):
    assert read().model_of(servo).name == model


@pytest.mark.parametrize("servo", ["mill-8", "", "line-\n7", "Line-1", "line-*"])
def test_a_servo_that_nothing_names_has_no_model(servo):
    with pytest.raises(InvalidInput, match="has no model"):
        read().model_of(servo)


def test_models_carry_settings_controller_and_start():
    plain, calm = read().models
    expected = TwinSettings(policy="paper", initial_gap=math.radians(1.0))
    assert plain.settings.replace(estimator=None) == expected
    assert plain.servo == Servo.preset("paper")
    assert plain.first_setting == Setting(
        plain.servo.tolerance_for(plain.settings.initial_gap), gains_of(plain.servo.controller)
    )
    assert calm.servo == Servo.preset("paper").replace(Ki=0.0)
    assert calm.first_setting == Setting(0.0, gains_of(calm.servo.controller))


@pytest.mark.slow
def test_without_a_start_it_is_the_verified_fallback_set_as_in_a_scenario():
    scenario = Scenario.preset("certified")
    model = ServoModel("axis", scenario.model, scenario.twin)
    assert model.first_setting == Setting(scenario.start_tolerance, gains_of(scenario.start_law))
    assert model.first_setting.gains != gains_of(scenario.law)


@pytest.mark.slow
def test_where_nothing_is_verified_nothing_is_known_of_the_start():
    wide = TwinSettings().uncertainty.replace(gap=(0.0, 6.0), input_bias=(-9.0, 9.0))
    few = Demands(machines=40, screened=2, conditions=4, scales=(0.5,), beyond=Beyond(machines=4))
    settings = TwinSettings(uncertainty=wide, demands=few)
    assert ServoModel("axis", Servo.preset("paper"), settings).first_setting is None


def of_axis(name: str, ranges: str = "") -> ServoModel:
    text = f'[models.axis]\nservo = "{name}"\n[models.axis.twin]\n[models.axis.twin.uncertainty]\n{ranges}'
    (model,) = models_of(parse_toml(text, "twin.toml"), Path(), checked=False)
    return model


@pytest.mark.parametrize("name", [name for name in AXES if Axis.preset(name).controller.voltage_limit is not None])
def test_a_bias_that_no_file_states_is_small_beside_the_command(name):
    model = of_axis(name)
    low, high = model.settings.uncertainty.input_bias
    assert low == -high
    assert high == min(0.1 * scales(model.servo).voltage, 0.01 * model.servo.controller.voltage_limit)


@pytest.mark.slow
def test_an_axis_has_a_fallback_set_where_its_file_states_gaps_and_steps_only():
    model = of_axis("ball-screw", "gap_deg = [0.0, 5.4]\nstep_mm = [0.15, 1.0]")
    few = Demands(machines=300, screened=2, beyond=Beyond(machines=4))
    assert ServoModel("axis", model.servo, model.settings.replace(demands=few)).first_setting is not None


def test_a_servos_file_lies_beside_the_fleets(tmp_path):
    servo = Servo.preset("paper").replace(k=9e3)
    (tmp_path / "axis.toml").write_text(servo.dumps())
    calm = read(folder=tmp_path, servo="axis.toml").model_of("line-7")
    assert calm.servo == servo.replace(Ki=0.0)


def test_a_fleet_survives_the_way_to_a_worker():
    fleet = read()
    fleet.model_of("line-1").twin(restored=False)
    again = pickle.loads(pickle.dumps(fleet))
    assert again == fleet
    assert again.model_of("line-1").twin(restored=False).initial_state("line-1")


def test_other_tables_are_left_to_others():
    table = parse_toml(TEXT.replace("{servo}", "paper") + "[service]\nport = 1\n", "twin.toml")
    ModelRegistry.read(table, Path())
    with pytest.raises(InvalidInput, match="unknown key 'service'"):
        table.done()
    table.table("service")
    table.done()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("ki_v_per_m_s", "ki", "twin.toml: unknown key 'models.calm.controller.ki'"),
        ('policy = "certified"', 'policy = "best"', "twin.toml: models.calm.twin.policy = 'best'"),
        ('"calm"\n"*-7"', '"clam"\n"*-7"', "servos.line-7 = 'clam': there is no such model (did you mean 'calm'?)"),
        ('"line-7"', '"line 7"', "servos: 'line 7' is not allowed"),
        ("[models.calm]", '[models."c lm"]', "'c lm' is not a name of a model"),
        ('servo = "{servo}"', 'servo = "axis.toml"', "twin.toml: models.calm.servo = 'axis.toml'"),
        ('servo = "{servo}"', "", "twin.toml: key 'models.calm.servo' is missing"),
        ("ki_v_per_m_s = 0.0", "ki_v_per_m_s = 1e9", "is unstable on this servo even without a gap"),
        (
            'policy = "certified"',
            'policy = "margin"\n[models.calm.controller.x]\n',
            "models.calm.controller.x",
        ),
        ("[servos]", "[servants]", "twin.toml: table [servos] is missing"),
        ("[models.", "[mods.", "twin.toml: table [models] is missing"),
    ],
)
def test_a_mistake_is_reported_in_one_sentence(old, new, message):
    with pytest.raises(InvalidInput) as caught:
        read(TEXT.replace(old, new))
    assert message in str(caught.value)
    assert str(caught.value).startswith("twin.toml: ")
    assert "\n" not in str(caught.value)


def test_a_policy_that_cannot_design_for_the_controller_is_refused_at_the_start():
    text = TEXT.replace('policy = "certified"', 'policy = "margin"').replace(
        "ki_v_per_m_s = 0.0", "ki_v_per_m_s = 0.0\nvoltage_limit_v = 24.0"
    )
    with pytest.raises(InvalidInput, match="policy 'margin'"):
        read(text)


@pytest.mark.parametrize(("models", "servos"), [(0, 1), (2, 1), (1, 0)])
def test_a_fleet_has_models_with_names_of_their_own_and_servos(models, servos):
    model = ServoModel("axis", Servo.preset("paper"), TwinSettings())
    with pytest.raises(InvalidInput):
        ModelRegistry((model,) * models, (("*", "axis"),) * servos)
