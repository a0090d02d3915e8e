"""Drives of machines whose controller is a cascade or a linear law, in both roles; and the nodes that OPC UA needs."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from machines import served
from numpy.typing import NDArray

import servotwin as st
from servotwin.commissioning.edge_settings import Recording
from servotwin.control.gains import gains_of
from servotwin.control.laws import AnyController
from servotwin.control.running_law import RunningLaw, command_of
from servotwin.cosim.machine import simulation_of
from servotwin.drives.opcua import model
from servotwin.drives.opcua.drive import OpcUaDrive
from servotwin.drives.opcua.settings import OpcUaSettings
from servotwin.drives.simulated import wire
from servotwin.drives.simulated.client import SimulatedSupervised
from servotwin.drives.simulated.plants import ControlledPlant, SupervisedPlant
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.edge.drive import DriveRefused
from servotwin.edge.parameters import Parameters
from servotwin.messages import AnyGains, Gains, LinearGains, Setting
from servotwin.twin.settings import TwinSettings

SCREW = st.Axis.preset("ball-screw")
CASCADE = st.Cascade(100.0, SCREW.p, velocity_gain=0.012, integral_time=0.02, voltage_limit=3.8, sample_rate=2000.0)
LINEAR = CASCADE.linear()
CHANNELS = ("reference", "theta_m", "position", "voltage")
SAMPLES = 800


def settings(law: AnyController, role: str) -> MachineSettings:
    scenario = st.Scenario(
        servo=SCREW.replace(controller=law), duration=SAMPLES / 2000.0, reference=st.SquareWave(5e-4, 0.3), gap=0.03,
        recording=Recording(sample_rate=2000.0, window=0.25), twin=TwinSettings(policy="paper", k_dz=0.0),
    )  # fmt: skip
    return MachineSettings(scenario, role, wire.parse_address("127.0.0.1:0"), speed=0.0, endless=False)


def simulated(law: AnyController, changed: AnyController | None = None) -> NDArray[np.float64]:
    simulation = simulation_of(settings(law, "supervise").scenario)
    if changed is not None:
        simulation.advance(SAMPLES // 2)
        simulation.set_controller(changed, 5e-6)
    simulation.advance(SAMPLES)
    return np.array([simulation.measured(name, 0, SAMPLES) for name in CHANNELS])


@pytest.mark.parametrize(
    ("law", "changes"),
    [(CASCADE, {"position_gain": 70.0, "integral_time": None}), (LINEAR, {"gain": 0.8, "integral_share": 0.5})],
    ids=["cascade", "linear"],
)
def test_a_supervised_machine_runs_any_law_and_takes_its_numbers(law: AnyController, changes: dict[str, Any]) -> None:
    law = SCREW.replace(controller=law).controller
    changed = law.replace(**changes)
    plant = SupervisedPlant(settings(law, "supervise"))
    packed = wire.packed_gains(gains_of(changed))
    plant.advance(SAMPLES // 2)
    plant.write(5, 5e-6, wire.gains_of(packed))
    plant.advance(SAMPLES // 2)
    parts = [plant.read(first, SAMPLES) for first in (0, SAMPLES // 2)]
    assert [part.version for part in parts if part] == [0, 5]
    assert np.array_equal(np.hstack([part.values for part in parts if part]), simulated(law, changed))


def test_a_cascade_outside_of_the_machine_gives_the_same_commands() -> None:
    plant, law = ControlledPlant(settings(CASCADE, "control")), RunningLaw(CASCADE)
    state, rows = law.start(0.0, 0.0), []
    for _ in range(SAMPLES):
        sample = plant.sample()
        state = law.tick(state, *sample)
        rows.append((*sample, command_of(state)))
        plant.tick(command_of(state))
    assert np.array_equal(np.array(rows).T, simulated(CASCADE))


def test_numbers_of_another_law_are_refused_through_the_socket(tmp_path: Path) -> None:
    (tmp_path / "axis.toml").write_text(SCREW.replace(controller=CASCADE).dumps())
    (tmp_path / "machine.toml").write_text(
        'role = "supervise"\nlisten = "127.0.0.1:0"\nspeed = 0.0\n[scenario]\nservo = "axis.toml"\nduration_s = 1.0\n'
        'reference = {kind = "step", size_mm = 0.5}\ngap = {total_deg = 1.0}\nrecording = {sample_rate_hz = 2000.0}\n'
        'twin = {policy = "paper", k_dz = 0.0}\n'
    )
    with served(tmp_path / "machine.toml") as address, closing(SimulatedSupervised(address)) as drive:
        drive.connect()
        with pytest.raises(DriveRefused, match="must be those of a Cascade"):
            drive.write(Parameters(1, Setting(0.0, Gains(1.0, 1.0, 0.0, 0.1))))
        drive.write(Parameters(2, Setting.of(1e-6, gains_of(CASCADE.replace(position_gain=80.0)))))
        block = drive.read(10)
    assert block is not None
    assert block.version == 2


class Nodes:
    """A session of a drive that has some variables, and accepts each commit at once."""

    def __init__(self, gains: Sequence[str]) -> None:
        self.gains, self.values = gains, dict.fromkeys((*model.DECISION, model.COMMIT, "Version", "Since"), 0)

    def has(self, name: str) -> bool:
        return name in self.gains

    def read(self, names: Sequence[str]) -> list[Any]:
        return ["" if name == "Refused" else self.values[name] for name in names]

    def write(self, values: Mapping[str, Any]) -> None:
        self.values |= values
        self.values["Committed"] = self.values[model.COMMIT]


def written(gains: AnyGains | None, variables: Sequence[str]) -> dict[str, Any]:
    drive, nodes = OpcUaDrive(OpcUaSettings("opc.tcp://localhost:4840")), Nodes(variables)
    drive._session = nodes  # type: ignore[assignment]
    drive.write(Parameters(4, Setting.of(1e-6, gains)))
    return nodes.values


OF_CASCADE = ("PositionGain", "VelocityGain", "IntegralTime", "SpeedFilter", "Enter", "Leave")


def test_a_cascade_goes_to_the_nodes_of_a_cascade() -> None:
    values = written(gains_of(CASCADE), OF_CASCADE)
    assert [values[name] for name in OF_CASCADE] == [100.0, 0.012, 0.02, 1e-3, 1.0, 1.0]
    assert (values["NewVersion"], values["Tolerance"], values["SetGains"]) == (4, 1e-6, True)


def test_a_dead_zone_alone_needs_no_gains() -> None:
    assert written(None, ())["SetGains"] is False


@pytest.mark.parametrize(
    ("gains", "variables", "missing"),
    [
        (gains_of(CASCADE), ("Kp", "Ki", "Kd", "Tf", "Enter", "Leave"), "PositionGain, VelocityGain, IntegralTime"),
        (gains_of(CASCADE.replace(notch_hz=40.0)), OF_CASCADE, "NotchHz, NotchDamping, NotchDepth"),
        (gains_of(CASCADE.replace(velocity_feedforward=1.0)), OF_CASCADE, "VelocityFeedforward"),
        (gains_of(LINEAR.replace(gain=0.5)), OF_CASCADE, "Gain, IntegralShare"),
        (LinearGains(), OF_CASCADE, "Gain, IntegralShare"),
        (LinearGains(), ("Kp", "Ki", "Kd", "Tf", "Enter", "Leave"), "Gain, IntegralShare"),
        (Gains(1.0, 1.0, 0.0, 0.1), OF_CASCADE, "Kp, Ki, Kd, Tf"),
    ],
)
def test_missing_nodes_are_named(gains: AnyGains, variables: Sequence[str], missing: str) -> None:
    with pytest.raises(DriveRefused, match=rf"has no variable {missing}$"):
        written(gains, variables)
