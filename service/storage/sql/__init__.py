"""Database layer: connections, tables, migrations, and the connection that writes."""
