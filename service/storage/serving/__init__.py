"""Which process writes to a database: locks on a SQLite file, and on PostgreSQL."""
