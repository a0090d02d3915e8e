"""Settings declared once: reader, check, writer, messages and docstring follow from the declaration."""

from dataclasses import dataclass, field
from math import inf, pi
from pathlib import Path
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.config.keys import check, items_of, key, settings
from servotwin.config.table import parse_toml
from servotwin.config.toml import changes, dumps, read, values_of
from servotwin.config.units import unit_of
from servotwin.errors import InvalidInput


@settings("motor")
@dataclass(frozen=True)
class Motor:
    """A motor."""

    speed: Annotated[float, key("speed_deg_per_s", above=0.0, help="Speed.")]
    poles: Annotated[int, key(minimum=2, maximum=8, help="Poles.")] = 4


def pause(begin: Annotated[float, key("from_s")], end: Annotated[float, key("to_s")]) -> tuple[float, float]:
    """One pause."""
    return begin, end


@settings("machine")
@dataclass(frozen=True)
class Machine:
    """A machine.

    Raises
    ------
    InvalidInput
        A value is out of its range.
    """

    size: Annotated[float, key("size_mm", "size_m", minimum=0.0, infinite=True, help="Largest move.")] = 1e-3
    share: Annotated[float, key("share_percent", minimum=0.0, below=1.0, help="Share.")] = 0.5
    mode: Annotated[str, key(choices=("fast", "slow"), help="Mode.")] = "fast"
    on: Annotated[bool, key(help="Runs.")] = True
    range: Annotated[tuple[float, float], key("range_deg", help="Range.")] = (0.0, pi)
    gains: Annotated[float | tuple[float, ...], key(above=0.0, help="Gains.")] = 1.0
    log: Annotated[Path | None, key(help="Log.")] = None
    motor: Annotated[Motor | None, key(help="The motor.")] = None
    spare: Annotated[Motor, key(prefix="spare_", help="Another.")] = field(default_factory=lambda: Motor(1.0))
    pauses: Annotated[
        tuple[tuple[float, float], ...], key(makers={"": pause}, dump=lambda each: {"from_s": each[0], "to_s": each[1]})
    ] = ()

    def __post_init__(self) -> None:
        check(self)


def machine(text: str) -> Machine:
    table = parse_toml(text + "\n", "m.toml") if text else parse_toml("on = true", "m.toml")
    made: Machine = read(table, Machine, Path("/base"))
    table.done()
    return made


def test_every_form_is_read_in_its_unit() -> None:
    made = machine(
        "size_mm = 2\nshare_percent = 25\nmode = 'slow'\non = false\nrange_deg = [0, 90]\ngains = [1, 2]\n"
        "log = 'a.csv'\nspare_poles = 6\n[motor]\nspeed_deg_per_s = 180\n[[pauses]]\nfrom_s = 1\nto_s = 2"
    )
    assert made == Machine(
        2e-3, 0.25, "slow", False, (0.0, 90 * (pi / 180)), (1.0, 2.0), Path("/base/a.csv"), Motor(180 * (pi / 180)),
        Motor(1.0, 6), ((1.0, 2.0),),
    )  # fmt: skip


def test_a_missing_key_keeps_its_default_or_that_of_a_base() -> None:
    assert machine("") == Machine()
    table = parse_toml("share_percent = 10", "m.toml")
    assert read(table, Machine, base=Machine(size=7.0)) == Machine(size=7.0, share=0.1)
    assert changes(table, Machine) == {"share": 0.1, "spare": Motor(1.0)}


def test_the_exact_key_overrides_the_other() -> None:
    assert machine("size_m = 0.5\nsize_mm = 2").size == 0.5


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("size_mm = -1", "m.toml: size_mm = -1 is not allowed; give a number, at least 0, inf allowed"),
        ("share_percent = 100", "m.toml: share_percent = 100 is not allowed; give a number, at least 0, below 100"),
        ("mode = 'fst'", "one of fast, slow (did you mean 'fast'?)"),
        ("range_deg = [1]", "m.toml: range_deg = [1] is not allowed; give two numbers"),
        ("range_deg = []", "m.toml: range_deg = [] is not allowed; give "),
        ("size_mm = []", "m.toml: size_mm = [] is not allowed; give a number, at least 0, inf allowed"),
        ("[motor]\npoles = 4", "m.toml: key 'motor.speed_deg_per_s' is missing"),
        ("[motor]\nspeed_deg = 4", "key 'motor.speed_deg_per_s' is missing (found 'motor.speed_deg' instead)"),
        ("[motor]\nspeed_deg_per_s = 1\npoles = 9", "motor.poles = 9 is not allowed; give an integer, at least 2"),
        ("[motor]\nspeed_deg_per_s = 1\npole = 4", "unknown key 'motor.pole' (did you mean 'poles'?)"),
        ("spare_poles = 1", "m.toml: spare_poles = 1 is not allowed; give an integer, at least 2, at most 8"),
        ("[[pauses]]\nfrom_s = 1", "key 'pauses[0].to_s' is missing"),
        ("colour = 1", "m.toml: unknown key 'colour'"),
    ],
)
def test_a_refusal_names_file_key_value_and_what_is_allowed(text: str, expected: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        machine(text)
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"size": -1.0}, "machine size = -1.0 m: must be a number, at least 0, inf allowed"),
        ({"share": 1.0}, "machine share = 1.0: must be a number, at least 0, below 1, finite"),
        ({"mode": "fst"}, "machine mode = 'fst': must be one of fast, slow (did you mean 'fast'?)"),
        ({"on": 1}, "machine on = 1: must be True or False"),
        ({"range": (1.0,)}, r"machine range = (1.0,) rad: must be two numbers, each a number, finite"),
        ({"gains": (1.0, -2.0)}, "machine gains[1] = -2.0: must be a positive number, finite"),
        ({"share": "a"}, "machine share = 'a': must be a number"),
    ],
)
def test_the_constructor_checks_the_same_ranges(values: dict[str, object], expected: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        Machine(**values)  # type: ignore[arg-type]
    assert str(caught.value).startswith(expected)


@pytest.mark.slow
@given(
    st.floats(0.0, 1e29) | st.just(inf), st.floats(0.0, 0.9), st.tuples(st.floats(-9, 9), st.floats(-9, 9)),
    st.floats(1e-9, 1e9), st.text(max_size=9).filter(str.isprintable),
)  # fmt: skip
def test_settings_written_are_read_back(
    size: float, share: float, ends: tuple[float, float], gain: float, log: str
) -> None:
    made = Machine(
        size, share, range=ends, gains=(gain, 1.0), motor=Motor(2.0), pauses=((0.5, gain + 1.0),), log=Path(log)
    )
    table = parse_toml(dumps(values_of(made)), "m.toml")
    again: Machine = read(table, Machine)
    assert (again.size, again.gains, again.log) == (size, (gain, 1.0), Path(log))
    assert (again.share, *again.range, again.motor.speed) == pytest.approx((share, *ends, 2.0), rel=1e-15, abs=0.0)


def test_the_suffix_of_a_key_gives_its_unit() -> None:
    assert [unit_of(name).name for name in ("gap_deg", "k_n_per_m", "n", "megabytes")] == ["deg", "N/m", "", "MB"]
    assert unit_of("rate_deg_per_s").to_si(180.0) == pi
    assert unit_of("share_percent").to_si(29.0) == 29.0 / 100.0


def test_the_docstring_lists_what_is_declared() -> None:
    assert Machine.__doc__ is not None
    assert "size : float\n    Largest move. In m.\n" in Machine.__doc__
    assert Machine.__doc__.index("Parameters") < Machine.__doc__.index("Raises")
    assert [item.name for item in items_of(Motor)] == ["speed", "poles"]
