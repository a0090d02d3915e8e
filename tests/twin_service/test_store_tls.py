"""PostgreSQL over TLS: the server's certificate is checked, its host's name too."""

from pathlib import Path

import postgres
import pytest
import sqlalchemy as sa
from selfsigned import self_made
from service_system import twin_file

from servotwin.errors import InvalidInput
from servotwin.twin_service.command import open_existing_store
from servotwin.twin_service.twin_file import service_of

OWN_TLS = "SELECT version FROM pg_stat_ssl WHERE pid = pg_backend_pid()"


@pytest.mark.slow
def test_only_the_server_of_the_certificate_is_trusted(tmp_path: Path) -> None:
    certificate, key = self_made(tmp_path)
    (tmp_path / "other").mkdir()
    self_made(tmp_path / "other")
    with postgres.running((certificate, key)) as server:
        server.database("twin")

        def opened(host: str, ca: str) -> str:
            """What a twin's connection says of its TLS."""
            url = f"postgresql://{server.user}@{host}:{server.port}/twin"
            config = service_of(twin_file(tmp_path, f'store = "{url}"\n{ca}', tokens=False))
            store = open_existing_store(config)
            try:
                with store.engines.reader.connect() as connection:
                    return str(
                        connection.scalar(sa.text("SELECT version FROM pg_stat_ssl WHERE pid = pg_backend_pid()"))
                    )
            finally:
                store.close()

        assert opened("127.0.0.1", 'store_ca = "made.crt"').startswith("TLSv1")
        for host, ca, fault in (
            ("127.0.0.1", "other/made.crt", "certificate"),
            ("localhost", "made.crt", "does not match"),
        ):
            with pytest.raises(InvalidInput, match="not available now") as refused:
                opened(host, f'store_ca = "{ca}"')
            assert fault in str(refused.value)
            assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("service", "fault"),
    [
        ('store_ca = "no.pem"', "no.pem: holds no certificates that can be read"),
        ('store_ca = "made.crt"', "store_ca is for PostgreSQL"),
        ('store = "postgresql://h/d?sslmode=require"\nstore_ca = "made.crt"', "exclude each other"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(tmp_path: Path, service: str, fault: str) -> None:
    self_made(tmp_path)
    with pytest.raises(InvalidInput, match=fault):
        service_of(twin_file(tmp_path, service, tokens=False))
