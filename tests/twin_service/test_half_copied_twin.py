"""A twin whose folder was copied in part, and one whose tokens became wrong: it says so and stores nothing wrong."""

import asyncio
import shutil
from pathlib import Path

import pytest
from service_system import OTHER, TOKEN, bearer, place, served, twin_file, window

from servotwin.errors import InvalidInput
from servotwin.link.seal import verifier_of
from servotwin.messages import encode
from servotwin.twin_service.auth import TokenFile, Verifiers, read_tokens, write_tokens
from servotwin.twin_service.twin_file import read_twin

WINDOWS = 40
REFUSED_AT_THE_START = (0.001, 0.3, 0.8)


async def send(client, sequence: int, token: str = TOKEN, servo: str = "ax-1") -> int:
    one = window(sequence, servo)
    answer = await client.put(place(one), content=encode(one), headers=bearer(token))
    return answer.status_code


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")

    async def fill() -> None:
        async with served(twin_file(folder)) as (_, client):
            for k in range(WINDOWS):
                assert await send(client, k) == 201

    asyncio.run(fill())
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.8, 0.99])
def test_a_store_that_was_cut_is_refused_or_not_written_or_known_to_lack_messages(
    whole: Path, tmp_path: Path, share: float, caplog: pytest.LogCaptureFixture
) -> None:
    copy = Path(shutil.copytree(whole, tmp_path / "copy"))
    data = (whole / "twin.db").read_bytes()
    (copy / "twin.db").write_bytes(data[: int(share * len(data))])

    async def look() -> tuple[int, str]:
        async with served(copy / "twin.toml") as (_, client):
            return await send(client, WINDOWS), (await client.get("/healthz")).json()["damage"]

    if share in REFUSED_AT_THE_START:
        with pytest.raises(InvalidInput, match=r"^[^\n]+twin.db: is damaged [^\n]+$"):
            asyncio.run(look())
    else:
        # The edges keep their windows; a new store takes them, and all edges are asked for those that they still have.
        status, damage = asyncio.run(look())
        assert (status, bool(damage)) in ((503, True), (201, False))
        assert ("the store has lost messages" in caplog.messages) == (status == 201)


@pytest.mark.parametrize("name", ["twin.toml", "tokens.toml"])
def test_wherever_a_file_is_cut_nobody_gets_in_who_had_no_token(whole: Path, tmp_path: Path, name: str) -> None:
    copy = Path(shutil.copytree(whole, tmp_path / "copy"))
    text, tokens = (whole / name).read_text(), read_tokens(whole / "tokens.toml")
    refusals: list[str] = []
    for end in range(len(text)):
        (copy / name).write_text(text[:end])
        try:
            twin = read_twin(copy / "twin.toml", models=False)
            found = read_tokens(copy / "tokens.toml")
        except InvalidInput as error:
            refusals.append(str(error))
        else:
            assert twin.service.tokens == copy / "tokens.toml"
            assert found.servos.items() <= tokens.servos.items()
            assert found.readers.items() <= tokens.readers.items()
    assert len(refusals) > 0.9 * len(text)
    assert all(name in refusal for refusal in refusals)


def test_wherever_the_tokens_are_cut_the_file_is_refused_and_the_former_tokens_stay(
    whole: Path, tmp_path: Path
) -> None:
    """Each servo whose token is missing would be refused as if its token were wrong."""
    path = tmp_path / "tokens.toml"
    shutil.copy(whole / "tokens.toml", path)
    text, file = path.read_text(), TokenFile(path)
    for end in range(len(text.rstrip())):
        path.write_text(text[:end])
        assert not file.refresh()
        assert file.fault.startswith(f"{path}: is ")
        file.access.check_servo("ax-1", TOKEN.encode())
    at_a_line = text[: text.index("[operators]")]
    for cut, sentence in (
        ("", "is empty; copy it again"),
        (at_a_line, "is cut short: its line '# end' is missing; copy"),
    ):
        path.write_text(cut)
        with pytest.raises(InvalidInput, match=sentence):
            read_tokens(path)


def test_tokens_that_an_earlier_version_wrote_are_read(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "tokens.toml"
    shutil.copy(whole / "tokens.toml", path)
    known, lines = read_tokens(path), path.read_text().splitlines()
    assert known.servos
    path.write_text("\n".join(lines[1:-1]))
    assert read_tokens(path) == known


def test_two_names_with_one_token_change_nothing_and_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """An identity that was copied into the file: the tokens of before stay, and both servos go on."""
    path = twin_file(tmp_path)

    async def body() -> None:
        async with served(path) as (system, client):
            assert (await client.get("/healthz")).json()["degraded"] == []
            known = system.tokens.access._verifiers
            twice = {**known.servos, "ax-2": verifier_of(TOKEN)}
            write_tokens(tmp_path / "tokens.toml", Verifiers(twice, known.operators, known.engineers))
            system.tokens.refresh()
            [sentence] = (await client.get("/healthz")).json()["degraded"]
            assert "'ax-1' and 'ax-2' have the same token" in sentence
            assert await send(client, 0) == await send(client, 0, OTHER, "ax-2") == 201
            assert await send(client, 1, TOKEN, "ax-2") == 403
            write_tokens(tmp_path / "tokens.toml", known)
            system.tokens.refresh()
            assert (await client.get("/healthz")).json()["degraded"] == []

    asyncio.run(body())
    assert "tokens not reloaded: the former ones stay" in caplog.messages
