"""Expiry of the twin's TLS certificate: read from the file, and told in time."""

import asyncio
import datetime
import logging
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from hypothesis import given
from hypothesis import strategies as some
from service_system import served, twin_file

from servotwin.twin_service.tls_expiry import valid_until

BEGIN = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
KEY = ec.generate_private_key(ec.SECP256R1())
PRIVATE = KEY.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())


def pem(until: datetime.datetime) -> bytes:
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "twin.example")])
    made = x509.CertificateBuilder(name, name, KEY.public_key(), x509.random_serial_number(), BEGIN, until)
    return made.sign(KEY, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


@given(some.integers(1, 100 * 365 * 86400))
def test_the_expiry_is_that_of_the_first_certificate_of_the_file(tmp_path_factory, seconds: int) -> None:
    """Also after 2049, from where on the standard has another form of time."""
    until, path = BEGIN + datetime.timedelta(seconds=seconds), tmp_path_factory.getbasetemp() / "chain.crt"
    path.write_bytes(b"twin, then its CA\n" + pem(until) + pem(BEGIN + datetime.timedelta(days=1)))
    assert valid_until(path) == until.timestamp()


@pytest.mark.parametrize(
    ("days", "words"), [(-1.0, "has expired on"), (10.0, "expires on"), (20.0, "")], ids=["expired", "soon", "later"]
)
def test_the_twin_says_when_its_certificate_expires(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, days: float, words: str
) -> None:
    path = twin_file(tmp_path, 'tls_certificate = "twin.crt"\ntls_key = "twin.key"')
    until = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)
    (tmp_path / "twin.crt").write_bytes(pem(until))
    (tmp_path / "twin.key").write_bytes(PRIVATE)

    async def body() -> list[str]:
        async with served(path) as (_, client):
            await asyncio.sleep(0.0)
            answer = await client.get("/healthz")
            return answer.json()["degraded"]

    with caplog.at_level(logging.WARNING):
        found = asyncio.run(body())
    assert len(found) == (1 if words else 0)
    for sentence in found:
        assert f"twin.crt {words} {until:%Y-%m-%d %H:%M} UTC" in sentence
        assert "restart the twin" in sentence
    assert ("certificate expires" in caplog.messages) == bool(words)
