"""Lost in space: the service's own solver in all conditions, compared with others."""
