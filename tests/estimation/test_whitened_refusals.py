"""The default estimator is silent where it cannot know, and says why."""

import math
from dataclasses import replace

import numpy as np
import pytest
from whitened_windows import SERVO, clean, failures, measured

from benchmarks import estimator_conditions as conditions
from benchmarks.estimator_windows import RATE, WindowCase, cut
from servotwin.errors import InvalidInput
from servotwin.estimation.core.contacts import Travel
from servotwin.estimation.core.visible import BOUND, TRAVEL, counted
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.whitened.estimator import WhitenedSettings, fit
from servotwin.estimation.whitened.gate import FitEvidence, judge
from servotwin.estimation.whitened.shift import ModelShift
from servotwin.estimation.window import Window
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave, Step
from servotwin.simulation import simulate


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"k": 1.01e4}, "stiffness off by -"),
        ({"c": 1.2 * 36.9}, "damping off by -"),
        ({"k": 0.99e4}, "stiffness off by +"),
    ],
)
def test_a_wrong_model_is_named(change, words):
    """Far off in the gap, covered by std_total, refused, and what is wrong with the model in words."""
    model = SERVO.replace(**change)
    for case in clean()[::4]:
        refused = estimate_gap(measured(case), model)
        assert refused.status is GapStatus.MODEL_MISMATCH
        assert any(words in reason for reason in refused.reasons), refused.reasons
        mild = estimate_gap(measured(case), model, settings=WhitenedSettings(largest_std=10.0, largest_shift=10.0))
        off = abs(mild.gap - case.gap)
        assert off > math.radians(0.03)
        assert off < 1.96 * mild.std_total


def hunting(ratio: float, calm: bool = False) -> Servo:
    """The paper's servo at 1 kHz, with a screw so many times as stiff as the structure."""
    law = SERVO.controller.replace(sample_rate=1000.0, **({"Ki": 0.0} if calm else {}))
    return SERVO.replace(k_d=ratio * float(SERVO.stiffnesses[1]), controller=law)


@pytest.mark.parametrize(("ratio", "k", "wrong"), [(1000.0, 1.074, 9.5), (200.0, 0.93, 1.9), (20.0, 1.03, 4.4)])
def test_a_wrong_minimum_is_refused_where_a_free_model_shows_another_gap(ratio, k, wrong):
    """A swinging load on an elastic screw without noise: what a wrong stiffness leaves is whitened away."""
    model = hunting(ratio)
    plant = model.replace(k=k * SERVO.k)
    run = simulate(plant, 13.0, reference=SquareWave(1e-3, 20.0), gap=math.radians(2.92), sample_rate=1000.0)
    window = Window.from_run(run, 9.7, 2.0)
    assert math.degrees(fit(window, model, None, None).aligned.whitened.point.gap) == pytest.approx(wrong, abs=0.1)
    found = estimate_gap(window, model)
    assert found.status is GapStatus.MODEL_MISMATCH
    assert f"the gap would be 2.92 deg: a stiffness off by {100.0 * (k - 1.0):+.2g} %" in found.reasons[-1]
    assert estimate_gap(window, plant).gap == pytest.approx(math.radians(2.92), abs=math.radians(1e-3))


def test_a_lower_bound_is_not_above_that_of_a_free_model():
    model = hunting(200.0, calm=True)
    plant = model.replace(k=1.055878 * SERVO.k, c=1.052926 * SERVO.c, p=0.995546 * SERVO.p)
    gap = math.radians(1.142902)
    run = simulate(plant, 13.0, reference=SquareWave(1e-3, 20.0), gap=gap, sample_rate=1000.0)
    found = estimate_gap(Window.from_run(run, 10.0 - 0.2348, 2.0), model)
    assert not found.ok
    assert not found.gap > gap


def test_a_window_that_begins_after_the_contact_bounds_no_gap():
    """Free motions took the place of a way of 34 deg to the contact, and 25 deg were stated of a gap of 8."""
    model = hunting(1000.0, calm=True)
    plant = model.replace(k=1.00118 * SERVO.k, c=0.934912 * SERVO.c, p=0.995702 * SERVO.p)
    gap, noise = math.radians(8.159), Noise(1e-6)
    for seed in (0, 1, 914111070):
        run = simulate(
            plant, 13.0, reference=SquareWave(1e-3, 20.0), gap=gap, sample_rate=1000.0, noise=noise, seed=seed
        )
        found = estimate_gap(Window.from_run(run, 10.1724, 1.0), model)
        assert not found.ok
        assert not found.gap > gap


@pytest.mark.slow
def test_a_compliant_screw_taken_as_rigid():
    assert failures(conditions.compliant_screw(3, (1e6,))) == []


def swapped(window: Window) -> Window:
    return window.replace(position=window.theta_m, theta_m=window.position)


BAD = {
    "wrong sign": (lambda w: w.replace(position=-w.position), "wrong sign"),
    "millimetres": (lambda w: w.replace(position=1e3 * w.position), "in mm"),
    "degrees": (lambda w: w.replace(theta_m=np.degrees(w.theta_m)), "in degrees"),
    "swapped": (swapped, "swapped"),
    "half rate": (lambda w: Window(w.position, w.theta_m, sample_rate=0.5 * RATE), "sample rate"),
    "constant position": (lambda w: w.replace(position=np.full(w.position.size, 1.0)), "position is constant"),
    "constant angle": (lambda w: w.replace(theta_m=np.full(w.position.size, 1.0)), "theta_m is constant"),
    "saturated position": (
        lambda w: w.replace(position=np.minimum(w.position, np.quantile(w.position, 0.8))),
        "saturated",
    ),
    "saturated angle": (lambda w: w.replace(theta_m=np.minimum(w.theta_m, np.quantile(w.theta_m, 0.8))), "saturated"),
    "wrapped angle": (lambda w: w.replace(theta_m=np.mod(w.theta_m, math.pi)), "wrapped"),
    "noise alone": (
        lambda w: w.replace(position=np.random.default_rng(1).standard_normal(w.position.size)),
        "unexplained",
    ),
    "half scale": (lambda w: w.replace(position=0.5 * w.position), "unexplained"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("number", [1, 7])
def test_bad_channels_are_named_and_never_a_number(name, number):
    spoil, words = BAD[name]
    estimate = estimate_gap(spoil(clean()[number].window), SERVO, prior=0.1)
    assert not estimate.ok
    assert estimate.gap == 0.1
    assert any(words in reason for reason in estimate.reasons), estimate.reasons


def test_nan_samples_are_refused_at_the_door():
    position = clean()[0].window.position.copy()
    position[17] = math.nan
    with pytest.raises(InvalidInput, match=r"position\[17\] = nan"):
        Window(position, clean()[0].window.theta_m, sample_rate=RATE)


def test_a_window_without_theta_m_or_too_short_is_refused():
    window = clean()[0].window
    with pytest.raises(InvalidInput, match="no theta_m"):
        estimate_gap(Window(window.position, sample_rate=RATE), SERVO)
    with pytest.raises(InvalidInput, match="at least 400"):
        estimate_gap(window.slice(window.start, 0.05), SERVO)
    with pytest.raises(InvalidInput, match="do not belong to method 'whitened'"):
        estimate_gap(window, SERVO, settings="none")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"passes": 0}, "passes = 0"),
        ({"skew": 1}, "skew = 1: must be True or False"),
        ({"offset": (0.0, 0.0)}, "offset"),
        ({"largest_std": math.nan}, "largest_std = nan"),
        ({"order": 2.5}, "order = 2.5"),
    ],
)
def test_settings_are_checked(settings, words):
    with pytest.raises(InvalidInput, match=words):
        WhitenedSettings(**settings)


def rocking(gap_deg: float, amplitude_deg: float, drift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """theta_m and theta_d (rad) of a motor that rocks and drifts."""
    from servotwin.plant.backlash import play

    time = np.arange(5000) / RATE
    theta_m = math.radians(amplitude_deg) * np.sin(9.0 * time) + drift * time
    return theta_m, play(theta_m, math.radians(gap_deg), 0.0)


def window_of(theta_m: np.ndarray, theta_d: np.ndarray, offset: float = 0.0) -> Window:
    from measured_windows import position_of

    noise = 1e-6 * np.random.default_rng(2).standard_normal(5000)
    return Window(position_of(SERVO, theta_d + offset, np.arange(5000) / RATE) + noise, theta_m, sample_rate=RATE)


def test_without_information_the_prior_comes_back():
    """The motor rocks within the gap: the screw rests, and the gap is at least as wide as the rocking."""
    window = window_of(*rocking(20.0, 4.0))
    known = estimate_gap(measured(clean()[4]), SERVO)
    for prior, gap, std in ((None, math.nan, math.inf), (0.2, 0.2, math.inf), (known, known.gap, known.std)):
        estimate = estimate_gap(window, SERVO, prior=prior)
        assert not estimate.ok
        assert estimate.reasons
        if estimate.status is GapStatus.UNIDENTIFIABLE:
            assert estimate.gap == pytest.approx(gap, nan_ok=True)
            assert estimate.std == std


def test_one_contact_needs_a_known_offset():
    """The screw is only ever pushed forwards: the gap and the encoder's offset act alike, unless one is known."""
    theta_m, theta_d = rocking(6.0, 1.0, drift=3.0)
    window = window_of(theta_m, theta_d)
    blind = estimate_gap(window, SERVO)
    assert not blind.ok
    assert "needed both ways" in " ".join(blind.reasons)
    with_offset = estimate_gap(
        window, SERVO, settings=WhitenedSettings(offset=(0.0, 1e-5), largest_std=math.radians(0.2))
    )
    assert with_offset.ok, with_offset.reasons
    assert abs(with_offset.gap - math.radians(6.0)) < 3.0 * with_offset.std
    assert with_offset.std < math.radians(0.2)


def at_rest(span: float = 1.0) -> tuple[WindowCase, ...]:
    """A calm loop long after its step: the motor creeps by less than a degree, the load by half a micrometre."""
    calm = SERVO.controller.replace(Ki=0.0)
    run = simulate(SERVO, 6.5, controller=calm, reference=SquareWave(1e-3, 12.0), gap=math.radians(10.0))
    return tuple(cut(run, start, span) for start in (4.0, 4.5, 5.0))


@pytest.mark.slow
@pytest.mark.parametrize("floor", [1e-8, 1e-6, 1e-5, 1e-4])
def test_noise_at_rest_is_no_wrong_model(floor):
    for seed, case in enumerate(at_rest()):
        estimate = estimate_gap(measured(case, seed, floor), SERVO)
        assert estimate.status in (GapStatus.UNIDENTIFIABLE, GapStatus.LOWER_BOUND), estimate
        if estimate.status is GapStatus.LOWER_BOUND:
            assert estimate.gap <= np.ptp(case.window.theta_m)


@pytest.mark.slow
def test_bounds_are_below_the_gap():
    """Calm loops show one contact: what they say of the gap is a bound, and never more than the gap."""
    found = [(estimate_gap(window, SERVO), gap) for window, gap in one_contact()]
    bounds = [(estimate.gap, gap) for estimate, gap in found if estimate.status is GapStatus.LOWER_BOUND]
    assert len(bounds) >= 6  # of 36; without noise the processor's rounding decides on one or two
    assert all(bound <= gap for bound, gap in bounds), bounds


def one_contact():
    """Windows of calm loops, 2 s long, with 1 um of noise or none."""
    calm = SERVO.controller.replace(Ki=0.0)
    for degrees in (5.0, 15.0):
        gap = math.radians(degrees)
        for tolerance in (None, SERVO.tolerance_for(gap), SERVO.tolerance_for(gap, 1.5)):
            run = simulate(SERVO, 5.0, controller=calm, reference=1e-3, gap=gap, tolerance=tolerance)
            for start in (0.0, 1.0, 2.5):
                case = cut(run, start, 2.0)
                yield case.window, gap
                yield measured(case), gap


def test_rounding_carries_no_information():
    """A window that the model explains to 1e-18 m, whatever the gap: how the sum rounds is no evidence."""
    servo = Servo.preset("table1")
    calm, gap = servo.controller.replace(Ki=0.0), math.radians(2.2616)
    wave = SquareWave(1.9107e-3, 11.5652)
    run = simulate(servo, 9.0, controller=calm, reference=wave, gap=gap, theta_d0=math.radians(-0.1167))
    for start in (7.4, 7.5223, 7.6):
        estimate = estimate_gap(cut(run, start, 1.0).window, servo)
        assert not estimate.ok
        assert estimate.status is not GapStatus.LOWER_BOUND or estimate.gap <= gap


def test_growth_is_among_the_reasons():
    run = simulate(SERVO, 22.0, reference=SquareWave(1e-3, 20.0), gap=SCurve(0.0, math.radians(60.0), 40.0))
    refused = [estimate_gap(cut(run, start, 1.0).window, SERVO) for start in (9.9, 10.2, 20.0)]
    assert any("grows by +" in reason for estimate in refused for reason in estimate.reasons), refused


def evidence(case: WindowCase) -> FitEvidence:
    """Evidence of a clean fit with a spread of 0.01 deg, against which nothing speaks."""
    fitted = fit(measured(case), case.servo, None, WhitenedSettings())
    assert fitted.aligned is not None
    gap, std = fitted.aligned.whitened.point.gap, math.radians(0.01)
    return FitEvidence(
        aligned=fitted.aligned,
        std=std,
        interval=(gap - 2.0 * std, gap + 2.0 * std),
        travel=Travel(1.0, 1.0, gap),
        shift=ModelShift(0.0, std, "", 0.0),
        observer=(0.0, math.inf),
        lost_motion=gap,
        unexplained=0.0,
        needed=TRAVEL,
        smallest=BOUND,
    )


@pytest.mark.parametrize(("deviations", "status"), [(2.0, GapStatus.OK), (5.0, GapStatus.MODEL_MISMATCH)])
@pytest.mark.parametrize("view", ["free model", "observer form", "lost motion"])
def test_another_view_counts_from_three_standard_deviations_on(view: str, deviations: float, status: GapStatus):
    """Noise moves every view of a window; only what noise cannot explain counts against the model."""
    seen, given = evidence(clean()[1]), WhitenedSettings()
    std = math.radians(0.1)
    most = 1.05 * seen.aligned.whitened.point.gap + seen.needed
    seen = {
        "free model": replace(seen, shift=ModelShift(0.8 * deviations * std, std, "a stiffness off", 100.0)),
        "observer form": replace(seen, observer=(-deviations * std, std)),
        "lost motion": replace(seen, std=0.2 * std, lost_motion=most + 0.2 * deviations * std),
    }[view]
    assert judge(seen, given)[0] is status


def test_a_free_model_that_is_no_likelier_does_not_refuse_the_estimate():
    """Free in directions that the window hardly shows, a model moves the gap by chance."""
    seen, std = evidence(clean()[1]), math.radians(0.02)
    moved = replace(seen, shift=ModelShift(5.0 * std, std, "a stiffness off", 10.0))
    assert judge(moved, WhitenedSettings())[0] is GapStatus.OK
    assert judge(replace(moved, shift=moved.shift._replace(gain=100.0)), WhitenedSettings())[0] is not GapStatus.OK


def test_coloured_noise_allows_a_smaller_spread_than_white_noise():
    seen, std = evidence(clean()[1]), math.radians(0.04)
    assert judge(replace(seen, std=std, colour=0.0), WhitenedSettings())[0] is GapStatus.OK
    assert judge(replace(seen, std=std, colour=1.0), WhitenedSettings())[0] is GapStatus.UNIDENTIFIABLE


def test_a_slow_motion_beyond_what_noise_leaves_is_a_wrong_model():
    """A swing of 0.14 mm rms at 7 Hz is 27 times what noise of 0.1 mm leaves of itself when averaged."""
    case = clean()[1]
    window = measured(case, floor=1e-4)
    assert estimate_gap(window, case.servo).status is not GapStatus.MODEL_MISMATCH
    swing = 2e-4 * np.sin(2.0 * math.pi * 7.0 * np.arange(window.position.size) / window.sample_rate)
    found = estimate_gap(window.replace(position=window.position + swing), case.servo)
    assert found.status is GapStatus.MODEL_MISMATCH
    assert "slow motion unexplained" in " ".join(found.reasons)


def test_counts_of_the_encoder_show_in_its_angle() -> None:
    time = np.arange(5000) / 5000.0
    angle = 3.0 * np.sin(9.0 * time)
    for count in (math.radians(1.0), 1e-3):
        assert counted(count * np.round(angle / count)) == pytest.approx(count, rel=1e-9)
    for smooth in (angle, time, np.zeros(5000), np.round(angle, 2) + 1e-4 * np.sin(50.0 * angle)):
        assert counted(smooth) == 0.0


def test_an_encoder_of_coarse_counts_is_refused_whether_or_not_they_are_stated() -> None:
    run = simulate(SERVO, 3.0, reference=Step(1e-3), gap=math.radians(10.0))
    window = Window.from_run(run, 0.0, 1.0)
    assert window.theta_m is not None
    assert estimate_gap(window, SERVO).ok
    for count, allowed in ((math.radians(0.05), True), (math.radians(1.0), False)):
        coarse = window.replace(theta_m=count * np.round(window.theta_m / count))
        for stated in (0.0, count):
            estimate = estimate_gap(coarse, SERVO.replace(encoder_resolution=stated))
            assert estimate.ok == allowed, estimate
