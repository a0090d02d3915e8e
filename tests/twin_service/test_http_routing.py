"""Routes: every request is answered in the form of the API, whatever is wrong with it; each route is described."""

import asyncio
import contextlib
from typing import Any

import msgspec
import pytest
from exploration import examples
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from service_system import OPERATOR, OTHER, TOKEN, served, twin_file, window

from servotwin.messages import encode
from servotwin.twin_service.http_app import HttpApp
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.refusals import Refusals

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
    left, sent = list(parts), []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": left.pop(0), "more_body": bool(left)}

    async def send(event: dict[str, Any]) -> None:
        sent.append(event)

    await app(dict(scope), receive, send)
    return sent[0]["status"], sorted(sent[0]["headers"]), b"".join(event.get("body", b"") for event in sent[1:])


@pytest.mark.slow
@pytest.mark.usefixtures("no_pause_for_refused")
@given(st.lists(requests(), min_size=1, max_size=40))
@examples(15, deadline=None, suppress_health_check=list(HealthCheck))
def test_a_malformed_request_is_answered_in_the_form_of_the_api(tmp_path_factory, requested):
    async def body() -> None:
        async with served(twin_file(tmp_path_factory.mktemp("twin"))) as (service, _):
            app = service.http_app()
            for scope, parts in requested:
                status, headers, content = await answered(app, scope, parts)
                assert status in {200, 201, 400, 401, 403, 404, 405, 409, 413, 422}
                by_name = dict(headers)
                assert int(by_name[b"content-length"]) == len(content)
                if status < 400:
                    assert by_name[b"content-type"] == b"application/msgpack"
                    continue
                assert by_name[b"content-type"] == b"application/json"
                assert set(msgspec.json.decode(content)) == {"code", "detail"}
                assert (b"allow" in by_name) == (status == 405)
                assert (b"www-authenticate" in by_name) == (status == 401)

    asyncio.run(body())


@pytest.mark.slow
def test_every_route_is_described_and_every_described_route_exists(tmp_path):
    async def body() -> None:
        async with served(twin_file(tmp_path, "lockstep = true")) as (_, client):
            described = (await client.get("/openapi.json")).json()
            assert described["openapi"].startswith("3.1")
            operations = [(path, method) for path, methods in described["paths"].items() for method in methods]
            assert len(operations) == 38
            for path, method in operations:
                answer = await client.request(method, path.replace("{sequence}", "1").replace("{file}", "app.js"))
                assert answer.status_code not in (404, 405) or path in ("/healthz", "/metrics"), (path, method)
                other = await client.request("PATCH", path)
                assert other.status_code == 405
                assert method.upper() in other.headers["allow"]

    asyncio.run(body())


def test_a_service_that_does_not_start_reports_it_to_the_server(tmp_path):
    """The lifespan protocol of ASGI: startup fails, or succeeds and is followed by shutdown."""

    @contextlib.asynccontextmanager
    async def broken():
        raise OSError("no workers")
        yield

    async def events(app: HttpApp) -> list[str]:
        sent: list[str] = []

        async def receive() -> dict[str, Any]:
            return {"type": "lifespan.startup" if not sent else "lifespan.shutdown"}

        async def send(event: dict[str, Any]) -> None:
            sent.append(event["type"])

        with contextlib.suppress(OSError):
            await app({"type": "lifespan"}, receive, send)
        return sent

    good = HttpApp([], Refusals(Metrics()), contextlib.nullcontext)
    assert asyncio.run(events(good)) == ["lifespan.startup.complete", "lifespan.shutdown.complete"]
    assert asyncio.run(events(HttpApp([], Refusals(Metrics()), broken))) == ["lifespan.startup.failed"]


def test_a_service_that_is_ended_by_a_second_interrupt_reports_no_failure():
    """The server cancels what still runs then, and would log the traceback of any failure."""

    async def events() -> list[str]:
        sent: list[str] = []

        async def receive() -> dict[str, Any]:
            return {"type": "lifespan.startup"} if not sent else await asyncio.Event().wait()

        async def send(event: dict[str, Any]) -> None:
            sent.append(event["type"])

        app = HttpApp([], Refusals(Metrics()), contextlib.nullcontext)
        running = asyncio.create_task(app({"type": "lifespan"}, receive, send))
        while not sent:
            await asyncio.sleep(0)
        running.cancel()
        await running
        return sent

    assert asyncio.run(events()) == ["lifespan.startup.complete"]
