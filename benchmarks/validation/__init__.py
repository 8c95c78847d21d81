"""Whether answers are right: docs/verification.md and the pages beside it."""
