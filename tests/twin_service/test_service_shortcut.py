"""Windows and questions for messages go past the framework's layers: it would answer the same, whatever is asked."""

import asyncio
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from service_system import OPERATOR, OTHER, TOKEN, served, twin_file, window

from servotwin.messages import encode

NAMES = ("ax-1", "ax-2", "ax-9", "b", "a/b", "..", "%2F", "ax-1\n", "é", "\0", "a" * 70, "", "0", "1", "01", "-1", "٣")
QUERIES = (
    "",
    "after=0",
    "after=7&wait=0",
    "after=0&after=x",
    "wait=0.001",
    "after=-1",
    "wait=31",
    "wait=nan",
    "after=%30",
)
AUTHORIZATIONS = ("", "Basic x", "Bearer", *(f"Bearer {token}" for token in (TOKEN, OTHER, OPERATOR, "guess", "é")))


@st.composite
def requests(draw: st.DrawFn) -> tuple[dict[str, Any], list[bytes]]:
    """Scope and body: of a window or a question, with something wrong about it now and then."""
    sent = window(draw(st.integers(0, 2)), draw(st.sampled_from(["ax-1", "ax-2"])))
    parts = [sent.servo, "windows", sent.boot, str(sent.sequence)]
    if draw(st.booleans()):
        parts[draw(st.sampled_from([0, 2, 3]))] = draw(st.sampled_from(NAMES))
    asks = draw(st.booleans())
    parts = [parts[0], "outgoing"] if asks else parts
    path = "/v1/servos/" + "/".join(parts) + draw(st.sampled_from(["", "", "/", "\n"]))
    values = {
        "authorization": draw(st.sampled_from((AUTHORIZATIONS[3], *AUTHORIZATIONS))),
        "content-encoding": draw(st.sampled_from(["", "identity", "deflate", "gzip"])),
        "content-length": draw(st.sampled_from(["", "5", "99999999", "x", "-1"])),
    }
    headers = [(key.encode(), value.encode("latin-1")) for key, value in values.items() if value]
    method = draw(st.sampled_from(["GET", "GET", "HEAD"] if asks else ["PUT", "PUT", "POST"]))
    query = draw(st.sampled_from(QUERIES)).encode()
    scope = {"type": "http", "method": method, "path": path, "headers": headers, "query_string": query}
    body = encode(sent)
    body = body[: draw(st.integers(0, len(body)))] if draw(st.booleans()) else body
    return {**scope, "root_path": "", "scheme": "http", "server": ("twin", 80)}, [body[:50], body[50:]]


async def answered(app: Any, scope: dict[str, Any], parts: list[bytes]) -> tuple[int, list[Any], bytes]:
    left, said = list(parts), []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": left.pop(0), "more_body": bool(left)}

    async def send(event: dict[str, Any]) -> None:
        said.append(event)

    await app(dict(scope), receive, send)
    return said[0]["status"], sorted(said[0]["headers"]), b"".join(event.get("body", b"") for event in said[1:])


@given(st.lists(requests(), min_size=1, max_size=40))
@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
def test_the_shortcut_answers_as_the_framework_does(tmp_path_factory, asked):
    """Each of two services is asked the same: one with the shortcut, one without."""

    async def body() -> None:
        one, other = (twin_file(tmp_path_factory.mktemp("twin")) for _ in range(2))
        async with served(one) as (short, _), served(other) as (long, _):
            through, around = short.app, long.app.api
            for scope, parts in asked:
                answer = await answered(through, scope, parts)
                assert answer == await answered(around, scope, parts)
                assert answer[0] in {200, 201, 400, 401, 403, 404, 405, 409, 413, 422}

    asyncio.run(body())
