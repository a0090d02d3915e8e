"""Decimation of a window's channels, and files of series."""

import csv
import io
import math
from array import array

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin import messages
from servotwin.config.units import SIGNAL_COLUMNS
from servotwin.dashboard.machine_facts import MachineFacts
from servotwin.dashboard.series import table_csv
from servotwin.dashboard.window_view import channel_series, envelope_indices, sample_range, window_columns
from servotwin.errors import InvalidInput
from servotwin.messages import pack_channel, pack_finely

RATE = 1000.0


def window(values, *more):
    channels = (pack_channel("position", "m", values), *pack_finely("theta_m", "rad", values), *more)
    return messages.WindowMessage(
        "a", "b", 1, 7.0, RATE, channels, (), 0, "m", "test", messages.checksum(channels)
    )  # fmt: skip


WAVE = [math.sin(0.37 * k) * (1.0 + 0.01 * k) for k in range(2000)]


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=400), st.integers(1, 40))
def test_an_envelope_keeps_the_ends_and_the_extremes_of_every_column(values, columns):
    kept = envelope_indices(array("d", values), columns)
    assert kept == sorted(set(kept))
    assert (kept[0], kept[-1]) == (0, len(values) - 1)
    assert len(kept) <= max(4 * columns, 2 * columns + 2)
    assert {min(values), max(values)} <= {values[k] for k in kept}


def test_a_peak_of_one_sample_survives():
    values = [0.0] * 1999
    values[1234] = 5.0
    (position, _) = channel_series(window(values), sample_range(window(values), None, None), 50)
    assert max(position["values"]) == pytest.approx(5.0)
    assert position["time"][position["values"].index(max(position["values"]))] == pytest.approx(1.234)
    assert position["samples"] == 1999


def test_a_part_at_full_rate_is_what_was_recorded():
    cut = window(WAVE)
    position, angle = channel_series(cut, sample_range(cut, 0.5, 0.6), 100)
    assert position["time"] == pytest.approx([0.5 + k / RATE for k in range(102)])
    assert angle["values"] == pytest.approx(WAVE[500:602], abs=1e-8)  # both parts of what was packed finely
    assert position["values"] == pytest.approx(WAVE[500:602], abs=2e-3)


@pytest.mark.parametrize("part", [(3.0, None), (1.0, 0.5), (2.5, 2.6)])
def test_an_empty_part_is_refused(part):
    with pytest.raises(InvalidInput, match="2 samples"):
        sample_range(window(WAVE), *part)


MACHINES = {
    "a servo": (MachineFacts(travel_unit="m", command_unit="V"), "m", "V", "voltage_v"),
    "a rotary axis": (MachineFacts(travel_unit="rad", command_unit="N m"), "rad", "N m", "command_n_m"),
    "a velocity drive": (MachineFacts(travel_unit="m", command_unit="rad/s"), "m", "rad/s", "command_rad_per_s"),
    "a stepper": (MachineFacts(travel_unit="m", command_unit="rad"), "m", "rad", "command_rad"),
}


@pytest.mark.parametrize(("machine", "travel", "command", "column"), MACHINES.values(), ids=MACHINES)
def test_a_file_has_every_sample_under_the_name_of_a_log_s_column(machine, travel, command, column):
    """Windows say V and m of every machine; its model knows its units."""
    recorded = window(WAVE, pack_channel("reference", "m", WAVE), *pack_finely("voltage", "V", WAVE))
    columns = window_columns(recorded, machine)
    assert list(columns) == ["time_s", f"position_{travel}", "theta_m_rad", f"reference_{travel}", column]
    assert set(columns) < {"time_s", *(name for names in SIGNAL_COLUMNS.values() for name in names)}
    assert columns["time_s"][:2] == [7.0, 7.001]
    assert len(columns["theta_m_rad"]) == 2000
    shown = channel_series(recorded, sample_range(recorded, None, None), 50, machine)
    assert [each["unit"] for each in shown] == [travel, "rad", travel, command]


def test_an_unknown_unit_is_not_made_up():
    recorded = window(WAVE, *pack_finely("voltage", "V", WAVE))
    assert list(window_columns(recorded)) == ["time_s", "position", "theta_m_rad", "command"]


def test_a_file_is_read_back_and_holds_no_formula():
    text = table_csv({"a": [1.5, None], "b": ['=HYPERLINK("x")', 'say "no", twice'], "c": [["x", "y"], []]})
    head, first, second = csv.reader(io.StringIO(text))
    assert head == ["a", "b", "c"]
    assert first == ["1.5", '\'=HYPERLINK("x")', "x; y"]
    assert second == ["", 'say "no", twice', ""]
