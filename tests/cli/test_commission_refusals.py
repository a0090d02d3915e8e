"""Sentences that `servotwin commission` says of hostile logs: file, column, what is wrong, and what to do."""

import gzip
import re

import numpy as np
import pytest
from drive_recordings import simulated
from typer.testing import CliRunner

from servotwin.cli import app as cli

HEADER = "t [s],motor [mm],force [N],reference [mm]"


def columns():
    recording = simulated()
    time = np.arange(recording.position.size) / recording.rate
    return np.column_stack([time, 1e3 * recording.position, recording.force, 1e3 * recording.reference])


def refusal(path):
    result = CliRunner().invoke(cli.app, ["commission", str(path)])
    assert result.exit_code == 2
    assert path.name in result.stderr
    return " ".join(result.stderr.split())


def coarse_stamps(rows):
    rows[:, 0] = np.floor(100.0 * rows[:, 0]) / 100.0


def counter_that_overflows(rows):
    rows[:, 1] = (rows[:, 1] + 3.0) % 20.0


def still(rows):
    rows[:, 1] = 3.2


def swapped(rows):
    rows[:, [1, 2]] = rows[:, [2, 1]]


def against(rows):
    rows[:, 2] *= -1.0


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            coarse_stamps,
            r"inertia does not show \(.* ± .* kg, 95 %\).*; 2947 of its samples have the time stamp of the one",
        ),
        (counter_that_overflows, r"column 'motor \[mm\]' jumps by most of its range of 19\.99 32 times: its counter"),
        (still, r"the position is 0\.0032 m throughout: .* is --motor another column"),
        (swapped, r"the inertia does not show .* are --motor and --command mixed up"),
        (against, r"acts against the motion \(inertia -20.* kg\): its sign is wrong"),
    ],
)
def test_a_hostile_log_is_refused_with_what_to_do(tmp_path, change, says):
    rows, log = columns(), tmp_path / "log.csv"
    change(rows)
    np.savetxt(log, rows, delimiter=",", header=HEADER, comments="", fmt="%.9g")
    assert re.search(says, refusal(log))


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("log.csv.gz", "unpack it first"),
        ("log.csv", "packed by gzip: unpack it"),
        ("log.xlsx", "export its sheet as .csv"),
    ],
)
def test_a_file_that_must_be_converted_first_is_refused_with_how(tmp_path, name, says):
    log = tmp_path / name
    log.write_bytes(gzip.compress(HEADER.encode()))
    assert says in refusal(log)
