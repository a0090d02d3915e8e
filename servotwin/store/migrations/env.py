"""Alembic's environment: runs the migrations on the given connection, in its transaction."""

from alembic import context

from servotwin.store.migrate import VERSIONS
from servotwin.store.schema import metadata

context.configure(connection=context.config.attributes["connection"], target_metadata=metadata, version_table=VERSIONS)
context.run_migrations()
