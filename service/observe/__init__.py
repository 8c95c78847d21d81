"""WHAT WAS SEEN: the batch, its forms as text, and its way to body vectors at one epoch."""
