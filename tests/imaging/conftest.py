"""The drawn picture of the tests of pictures, and the sky in which it is solved."""

from tests.features.pictures.conftest import blind, picture

__all__ = ["blind", "picture"]
