"""Words of answers: those of this version for a type checker, else any text."""
# Written by `make client` from service/contract.

from typing import TYPE_CHECKING, Literal

OutcomeWord = Literal["unique", "ambiguous", "unmatched"]
StatusWord = Literal["good", "suspect"]
IdentifierWord = Literal["starid", "verified", "ptp", "lost_in_space"]
if TYPE_CHECKING:
    Outcome = OutcomeWord
    Status = StatusWord
    Identifier = IdentifierWord
else:
    # A later service may know further words: they are read, too.
    Outcome = Status = Identifier = str
