"""Connections, tables, migrations, and the one writer."""
