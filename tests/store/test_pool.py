"""Connections of a pool that was disposed while they were in use."""

import gc
import warnings

import pytest
import sqlalchemy as sa
from store_cases import NewAddress

from servotwin.store.engine import engines_of, parse_address

pytest_plugins = ("store_fixtures",)


def test_a_connection_that_is_given_back_after_its_pool_was_disposed_is_closed(new_address: NewAddress) -> None:
    engines = engines_of(parse_address(new_address()))
    with engines.reader.connect() as connection:
        held = connection.connection.dbapi_connection
        engines.dispose()
        assert connection.execute(sa.text("SELECT 1")).scalar_one() == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of psycopg, as it is left open
        with pytest.raises(Exception, match="closed"):
            held.cursor().execute("SELECT 1")
        del held, connection
        gc.collect()
    with engines.reader.connect() as connection:
        assert connection.execute(sa.text("SELECT 2")).scalar_one() == 2
    engines.dispose()
