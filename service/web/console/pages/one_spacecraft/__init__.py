"""The pages of one spacecraft."""
