"""What people write and sign: their name, and a comment."""

from typing import Annotated

from pydantic import AfterValidator, Field


def without_nul(text: str | None) -> str | None:
    """The text; raises `ValueError` for a NUL character, which PostgreSQL does not store."""
    if text is not None and "\x00" in text:
        raise ValueError("must have no NUL character")
    return text


Who = Annotated[
    str | None,
    Field(
        min_length=1,
        max_length=64,
        description="Your name. Required while access is open; with a token, the service uses "
        "the token's name.",
    ),
    AfterValidator(without_nul),
]
Comment = Annotated[
    str | None,
    Field(max_length=2_000, description="A comment."),
    AfterValidator(without_nul),
]
