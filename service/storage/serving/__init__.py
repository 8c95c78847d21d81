"""Which process serves a database: locks on a SQLite file, and on PostgreSQL."""
