"""Runs the migrations on the connection that `service.storage.sql.migrations` hands over."""

from alembic import context

from service.storage.sql.columns import metadata

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=metadata,
    # SQLite changes a table by making it anew; its DDL is part of the transaction, as
    # PostgreSQL's is, because the service's connections begin theirs by name.
    render_as_batch=True,
    transactional_ddl=True,
)
with context.begin_transaction():
    context.run_migrations()
