"""Lost in space: which stars these are, and where that points, with nothing known before."""
