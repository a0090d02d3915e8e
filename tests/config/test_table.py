"""Every refusal of a TOML file is one sentence that names file, key, value and what is allowed."""

from pathlib import Path

import pytest

from servotwin.config.table import Table, did_you_mean, parse_toml, read_toml
from servotwin.errors import InvalidInput


def table(text: str) -> Table:
    return parse_toml(text, "a.toml")


def test_values_of_every_type() -> None:
    top = table(
        'size = 3\nspeed = 2\nname = "x"\non = true\nlist = [1, 2.5]\n[part]\nmass_kg = 1e3\n[[link]]\nloss = 0.5'
    )
    assert (top.integer("size"), top.number("speed"), top.text("name"), top.boolean("on")) == (3, 2.0, "x", True)
    assert top.numbers("list") == (1.0, 2.5)
    assert top.table("part").number("mass_kg") == 1000.0
    assert [link.number("loss") for link in top.tables("link")] == [0.5]
    top.done()


def test_a_number_may_stand_for_a_list() -> None:
    assert table("m = 2").numbers("m") == 2.0


def test_defaults() -> None:
    top = table("a = 1")
    assert top.number("b", None) is None
    assert top.number("c", 2.0) == 2.0
    assert top.text("d", "x", choices=("x",)) == "x"
    assert top.integer("e", 4) == 4
    assert top.boolean("f", False) is False
    assert top.numbers("g", None) is None
    assert top.tables("h") == []
    assert dict(top.table("i").values) == {}


def test_infinity_where_it_is_allowed() -> None:
    assert table("k = inf").number("k", infinite=True) == float("inf")


@pytest.mark.parametrize(
    ("text", "ask", "shown", "allowed"),
    [
        ("m = -1.5", lambda t: t.number("m", positive=True), "m = -1.5", "a positive number, finite"),
        ("m = 0", lambda t: t.number("m", positive=True), "m = 0", "a positive number, finite"),
        ("m = nan", lambda t: t.number("m", infinite=True), "m = nan", "a number, inf allowed"),
        ("m = inf", lambda t: t.number("m"), "m = inf", "a number, finite"),
        (
            "m = -inf",
            lambda t: t.number("m", minimum=0, infinite=True),
            "m = -inf",
            "a number, at least 0, inf allowed",
        ),
        ("m = true", lambda t: t.number("m"), "m = True", "a number, finite"),
        (f"m = {10**400}", lambda t: t.number("m"), f"m = 1{'0' * 56}...", "a number, finite"),
        ('m = "5 kg"', lambda t: t.number("m"), "m = '5 kg'", "a number, finite"),
        ("m = 3", lambda t: t.number("m", minimum=0, maximum=1), "m = 3", "a number, at least 0, at most 1, finite"),
        ("m = [1, -2]", lambda t: t.numbers("m", positive=True), "m[1] = -2", "a positive number, finite"),
        ("m = []", lambda t: t.numbers("m"), "m = []", "a number, finite or a list of such"),
        ("m = {}", lambda t: t.numbers("m"), "m = {}", "a number, finite or a list of such"),
        ("n = 2.0", lambda t: t.integer("n", minimum=2), "n = 2.0", "an integer, at least 2"),
        ("n = 1", lambda t: t.integer("n", minimum=2), "n = 1", "an integer, at least 2"),
        ("n = false", lambda t: t.integer("n"), "n = False", "an integer"),
        ("s = 1", lambda t: t.text("s"), "s = 1", "a text in quotes"),
        ('s = "b"', lambda t: t.text("s", choices=("xx", "y")), "s = 'b'", "one of xx, y"),
        ('s = "xxx"', lambda t: t.text("s", choices=("xx", "y")), "s = 'xxx'", "one of xx, y (did you mean 'xx'?)"),
        ("b = 1", lambda t: t.boolean("b"), "b = 1", "true or false"),
        ("p = 1", lambda t: t.table("p"), "p = 1", "a table [p]"),
        ("p = [1]", lambda t: t.tables("p"), "p = [1]", "an array of tables [[p]]"),
        ("[p]\nx = -1", lambda t: t.table("p").number("x", minimum=0), "p.x = -1", "a number, at least 0, finite"),
        ("[p.q]\nx = 's'", lambda t: t.table("p").table("q").number("x"), "p.q.x = 's'", "a number, finite"),
        ("[[p]]\nx = 's'", lambda t: t.tables("p")[0].number("x"), "p[0].x = 's'", "a number, finite"),
    ],
)
def test_values_out_of_range(text: str, ask, shown: str, allowed: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InvalidInput) as caught:
        ask(table(text))
    assert str(caught.value) == f"a.toml: {shown} is not allowed; give {allowed}"


@pytest.mark.parametrize(
    ("text", "ask", "message"),
    [
        ("a = 1", lambda t: t.number("m"), "key 'm' is missing"),
        ("mas_kg = 1", lambda t: t.number("mass_kg"), "key 'mass_kg' is missing (found 'mas_kg' instead)"),
        ("damping_n_m_s_per_rad = 1", lambda t: t.number("pitch_m_per_rad"), "key 'pitch_m_per_rad' is missing"),
        ("[p]\nmas = 1", lambda t: t.table("p").text("mass"), "key 'p.mass' is missing (found 'p.mas' instead)"),
        ("a = 1", lambda t: t.table("motor", required=True), "table [motor] is missing"),
        ("[moter]", lambda t: t.table("motor", required=True), "table [motor] is missing (found 'moter' instead)"),
    ],
)
def test_missing_keys(text: str, ask, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InvalidInput) as caught:
        ask(table(text))
    assert str(caught.value) == f"a.toml: {message}"


def test_unknown_keys_are_refused_with_a_hint() -> None:
    top = table("duration_s = 1\nsed = 4")
    top.number("duration_s")
    top.integer("seed", 0)
    with pytest.raises(InvalidInput) as caught:
        top.done()
    assert str(caught.value) == (
        "a.toml: unknown key 'sed' (did you mean 'seed'?); the top level allows duration_s, seed"
    )


def test_wrong_unit_is_an_unknown_key() -> None:
    part = table("[gap]\nfrom_rad = 1").table("gap")
    part.number("from_deg", 0.0)
    with pytest.raises(
        InvalidInput, match=r"unknown key 'gap.from_rad' \(did you mean 'from_deg'\?\); table \[gap\] allows"
    ):
        part.done()


def test_a_table_without_keys_says_so() -> None:
    with pytest.raises(InvalidInput, match="the top level allows no key at all"):
        table("a = 1").done()


def test_long_values_are_cut() -> None:
    with pytest.raises(InvalidInput) as caught:
        table(f'name = "{"x" * 500}"').number("name")
    assert len(str(caught.value)) < 140


def test_files(tmp_path: Path) -> None:
    good = tmp_path / "good.toml"
    good.write_text("a = 1")
    assert read_toml(good).number("a") == 1.0
    assert read_toml(str(good)).source == str(good)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty; it must hold at least one key"),
        (b"# only a comment\n", "is empty; it must hold at least one key"),
        (b"a = = 1", "is not a TOML file (Invalid value (at line 1, column 5))"),
        (b"a = 1\na = 2", "is not a TOML file (Cannot overwrite a value"),
        (b"\xff\xfe\x00", "is not a TOML file (byte 0 is not UTF-8)"),
    ],
)
def test_unreadable_content(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(InvalidInput) as caught:
        read_toml(path)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"nowhere\.toml: cannot be read \(No such file or directory\)"):
        read_toml(tmp_path / "nowhere.toml")
    with pytest.raises(InvalidInput, match="is a folder; give the name of a file"):
        read_toml(tmp_path)


def test_did_you_mean() -> None:
    assert did_you_mean("mass", ["mass_kg", "pitch"]) == " (did you mean 'mass_kg'?)"
    assert did_you_mean("zzz", ["mass_kg"]) == ""
    assert did_you_mean("gap_mm", ["gap_deg", "step_mm"]) == " (did you mean 'gap_deg'?)"
    assert did_you_mean("kp", ["p", "Kp"]) == " (did you mean 'Kp'?)"
