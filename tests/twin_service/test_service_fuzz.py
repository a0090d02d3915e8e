"""Random requests to the service: it always responds in the form of its API, and never with an internal error."""

import asyncio
import zlib

import httpx
import pytest
from exploration import examples
from hypothesis import HealthCheck, example, given
from hypothesis import strategies as st
from service_system import SERVO, bearer, hello, place, process, served, twin_file, window

from servotwin.messages import Refusal, encode
from servotwin.messages.checks import InvalidMessage
from servotwin.messages.codec import ENCODINGS, compress, decompress

ANY = SERVO.replace('"ax-*"', '"*"')
CODES = {refusal.value for refusal in Refusal}
REFUSED = {400, 401, 403, 404, 405, 409, 413, 422, 429}
LIMIT = 50_000


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    """A service without tokens that looks after every servo."""
    path = twin_file(tmp_path_factory.mktemp("twin"), "rate_limit_per_s = 1e6\nrate_burst = 1e6", False, ANY)
    with process(path) as (_running, url):
        yield url
        assert httpx.get(f"{url}/healthz").json()["ok"] is True


@pytest.fixture
def described(url):
    import schemathesis  # a second, which only this test takes

    @schemathesis.serializer("application/msgpack")
    def raw(_context, value):
        """A body is bytes already."""
        return value.data if hasattr(value, "data") else value

    return schemathesis.openapi.from_url(f"{url}/openapi.json")


@pytest.mark.slow
@given(st.data())
@examples(40, deadline=None, suppress_health_check=list(HealthCheck))
def test_requests_that_the_openapi_document_allows(described, data):
    """And headers, cookies and bodies of its own making."""
    from schemathesis.checks import not_a_server_error

    operations = [result.ok() for result in described.get_all_operations()]
    finite = [each for each in operations if each.path != "/v1/fleet/events"]  # a stream does not end
    case = data.draw(st.one_of([each.as_strategy() for each in finite]))
    if "wait" in (case.query or {}):
        case.query["wait"] = "0.01"
    answer = case.call(timeout=20.0)
    case.validate_response(answer, checks=[not_a_server_error])
    if answer.status_code >= 400:
        assert answer.status_code in REFUSED
        assert answer.json()["code"] in CODES


WINDOW, LETTER = encode(window(0, start=0.0)), hello()


@st.composite
def bodies(draw):
    """Messages, damaged in all sorts of ways, and things that never were messages."""
    whole = draw(st.sampled_from([WINDOW, LETTER, b"", b"\x00", b"\xdf\xff\xff\xff\xff", b"\x81\xa4type\xa8window/7"]))
    kind = draw(st.sampled_from(["whole", "cut", "flipped", "more", "any"]))
    if kind == "any" or not whole:
        return draw(st.binary(max_size=2000))
    at = draw(st.integers(0, len(whole) - 1))
    flipped = whole[:at] + bytes([whole[at] ^ draw(st.integers(1, 255))]) + whole[at + 1 :]
    return {"whole": whole, "cut": whole[:at], "flipped": flipped, "more": whole + draw(st.binary(max_size=50))}[kind]


@pytest.mark.slow
@given(
    body=bodies(),
    sent=st.sampled_from(["", "deflate", "zstd"]),
    declared=st.sampled_from(["", "identity", "deflate", "zstd", "gzip", "x" * 300]),
    path=st.sampled_from(
        [place(window(0)), "/v1/servos/ax-1/letters", "/v1/servos/%00/letters", "/v1/servos/a%2Fb/letters"]
    ),
)
@example(body=zlib.compress(bytes(40_000_000)), sent="", declared="deflate", path=place(window(0)))
@examples(25, deadline=None)
def test_bodies_and_encodings(url, body, sent, declared, path):
    headers = {"content-encoding": declared} if declared else {}
    method = "PUT" if "windows" in path else "POST"
    answer = httpx.request(method, url + path, content=compress(body, sent), headers=headers, timeout=20.0)
    if answer.status_code >= 300:
        assert answer.status_code in REFUSED
        assert answer.json()["code"] in CODES


@given(st.binary(max_size=3000), st.sampled_from(ENCODINGS), st.booleans())
def test_decompression_gives_no_more_than_is_allowed(data, encoding, whole):
    packed = compress(data * 40, encoding) if whole else data
    try:
        result = decompress(packed, encoding, LIMIT)
    except InvalidMessage as error:
        refusal = error.refusal
        result = b""
    else:
        refusal = None
    assert refusal in (None, Refusal.TOO_LARGE, Refusal.NOT_UNDERSTOOD)
    assert len(result) <= LIMIT
    if whole:
        assert refusal is (Refusal.TOO_LARGE if len(data) * 40 > LIMIT else None)
        assert refusal is not None or result == data * 40


@pytest.mark.slow
@pytest.mark.usefixtures("no_pause_for_refused")
@given(st.text(max_size=100), st.text(max_size=40))
@examples(25, deadline=None)
def test_headers_and_queries(tmp_path_factory, header, query):
    """In this process, with tokens: nothing gets in, nothing breaks."""
    path = tmp_path_factory.mktemp("twin")

    async def body():
        async with served(twin_file(path)) as (_system, client):
            value = header.encode("utf-8", "replace").replace(b"\r", b"").replace(b"\n", b"").replace(b"\0", b"")
            headers = [(b"authorization", b"Bearer " + value), (b"content-encoding", value[:60])]
            answer = await client.get(
                "/v1/servos/ax-1/outgoing", params={"after": query, "wait": query}, headers=headers
            )
            assert answer.status_code in (401, 403)
            sane = await client.get("/v1/servos/ax-1/outgoing", params={"after": query}, headers=bearer())
            assert sane.status_code in (200, 400)

    asyncio.run(body())
