"""Lost in space: the service's own solver in every condition, and beside others."""
