"""A linear law in the file of an axis: matrices or a system's file, read back bit for bit, refused in a sentence."""

from pathlib import Path

import control
import numpy as np
import pytest
from scipy import signal
from scipy.io import savemat

from servotwin.control.cascade import Cascade
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis

DRIVE = Axis.preset("two-mass-drive")
CASCADE = Cascade(2.0, 1.0, velocity_gain=30.0, integral_time=0.5, notch_hz=20.0, voltage_limit=60.0, sample_rate=2e3)
# s / (s + 50) acts on the error as well as a gain does: stable on the drive.
LEAD = signal.lti([60.0 + 20.0 * 50.0, 60.0 * 50.0], [1.0, 50.0]).to_ss()


def drive_with(controller: str, folder: Path) -> Axis:
    text = DRIVE.dumps()
    path = folder / "axis.toml"
    path.write_text(text[: text.index("[controller]")] + '[controller]\nkind = "linear"\n' + controller)
    return Axis.from_file(path)


@pytest.mark.parametrize(
    "law",
    [
        CASCADE.linear().replace(gain=0.9, integral_share=0.5, enter=0.5, leave=1.5, release_time=0.25),
        CASCADE.replace(sample_rate=None, on="motor").linear(),
        LinearLaw((), (), (), (2000.0, 0.0, -2000.0), 200.0, feedforward=0.1, rate_limit=900.0, ratio=5e-4),
    ],
    ids=["discrete", "continuous", "no states"],
)
def test_a_law_comes_back_bit_for_bit(law: LinearLaw) -> None:
    axis = (DRIVE if law.n else Axis.preset("telescope")).replace(controller=law)
    assert Axis.loads(axis.dumps(), "axis.toml") == axis


def test_the_keys_are_in_the_units_of_the_axis() -> None:
    text = DRIVE.replace(controller=CASCADE.linear().replace(rate_limit=900.0)).dumps()
    assert "torque_limit_n_m = 60.0" in text
    assert "rate_limit_n_m_per_s = 900.0" in text
    assert "travel_rad_per_rad = 1.0" in text


@pytest.mark.parametrize("name", ["law.npz", "law.mat"])
def test_a_system_of_scipy_comes_from_its_file(tmp_path: Path, name: str) -> None:
    matrices = {name: getattr(LEAD, name) for name in "ABCD"}
    if name.endswith(".npz"):
        np.savez(tmp_path / name, **matrices)
    else:
        savemat(tmp_path / name, matrices)
    axis = drive_with(f'system = "{name}"\ntorque_limit_n_m = 60.0\n', tmp_path)
    assert axis.controller == LinearLaw.from_system(
        LEAD, ratio=DRIVE.p, voltage_limit=60.0, release_time=axis.controller.release_time
    )
    assert Axis.loads(axis.dumps(), "again.toml") == axis


def test_a_sampled_system_of_python_control_brings_its_rate(tmp_path: Path) -> None:
    system = control.sample_system(control.ss(LEAD.A, LEAD.B, LEAD.C, LEAD.D), 1e-3)
    np.savez(tmp_path / "law.npz", A=system.A, B=system.B, C=system.C, D=system.D, dt=system.dt)
    law = drive_with('system = "law.npz"\n', tmp_path).controller
    assert isinstance(law, LinearLaw)
    assert (law.sample_rate, law.discrete) == (1000.0, True)
    assert law == LinearLaw.from_system(system, ratio=DRIVE.p, release_time=law.release_time)


GOOD = "A = [[-50.0]]\nB = [[1.0, 0.0, -1.0]]\nC = [-47000.0]\nD = [1060.0, 0.0, -1060.0]\n"


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (GOOD + "sampel_rate_hz = 100.0\n", r"axis.toml: unknown key 'controller.sampel_rate_hz'.*sample_rate_hz"),
        (GOOD + "sample_rate_hz = -1.0\n", "controller.sample_rate_hz = -1.0 is not allowed; give a positive number"),
        (GOOD + "voltage_limit_v = 6.0\n", r"controller.voltage_limit_v'.*torque_limit_n_m"),
        (GOOD + "discrete = true\n", "law sample_rate = None: discrete matrices need their rate in Hz"),
        (GOOD + 'holds = ["integral"]\n', "law holds = 'integral': the law has no such state; it has x1"),
        (
            GOOD.replace("[[-50.0]]", '[["-50"]]'),
            "controller.A = .*; give a list of rows, each a list of numbers",
        ),
        (GOOD.replace("[1.0, 0.0, -1.0]", "[1.0, -1.0]"), "law B = .*: must be 1 by 3 numbers"),
        (GOOD.replace("-47000.0", "47000.0"), "is unstable on this axis even without a gap"),
        ("", "law D: is missing; give A, B, C and D, or system"),
        (GOOD + 'system = "law.npz"\n', "brings A, B, C, D and dt; leave A, B, C, D and discrete out"),
        ('system = "law.csv"\n', "law.csv: must be a .npz or a .mat"),
        ('system = "none.npz"\n', r"none.npz: cannot be read \(No such file"),
        ('system = "text.npz"\n', r"text.npz: is no .npz file of matrices"),
        ('system = "lower.npz"\n', r"lower.npz: has no A \(did you mean 'a'\?\); it has a, b"),
    ],
)
def test_a_wrong_law_is_refused_in_one_sentence(tmp_path: Path, keys: str, message: str) -> None:
    (tmp_path / "text.npz").write_text("A = 1")
    np.savez(tmp_path / "lower.npz", a=1.0, b=2.0)
    with pytest.raises(InvalidInput, match=message) as refusal:
        drive_with(keys, tmp_path)
    assert "axis.toml" in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dt": True}, "dt = .*must be the sample time in s, or 0 of a continuous system"),
        ({"dt": -1e-3}, "dt = .*must be the sample time in s"),
        ({"B": np.ones((1, 1, 1))}, "B has 3 dimensions of float64; it must be a matrix of real numbers"),
        ({"A": np.array([[-50.0 + 1.0j]])}, "A has 2 dimensions of complex128; it must be a matrix of real numbers"),
    ],
)
def test_matrices_that_are_none_are_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    # As docs/controllers.md shows it: scipy's continuous systems have no dt.
    recipe = {"A": LEAD.A, "B": LEAD.B, "C": LEAD.C, "D": LEAD.D, "dt": LEAD.dt or 0}
    np.savez(tmp_path / "law.npz", **recipe)
    assert drive_with('system = "law.npz"\ntorque_limit_n_m = 60.0\n', tmp_path).controller.sample_rate is None
    np.savez(tmp_path / "law.npz", **{**recipe, **changes})
    with pytest.raises(InvalidInput, match=message):
        drive_with('system = "law.npz"\ntorque_limit_n_m = 60.0\n', tmp_path)


@pytest.mark.parametrize("content", [bytes(500), b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b"\xff" * 64])
def test_a_damaged_mat_file_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "law.mat").write_bytes(content)
    with pytest.raises(InvalidInput, match=r"is no \.mat file of matrices"):
        drive_with('system = "law.mat"\n', tmp_path)
