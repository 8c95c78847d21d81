"""Writer of SPICE text kernels, among them the leap-second kernel."""

import erfa

_MONTHS = {1: "JAN", 7: "JUL"}


def leap_second_kernel() -> str:
    """Text of a leap-second kernel (LSK) with ERFA's table and NAIF's constants."""
    steps = [
        f"  {int(count)}, @{year}-{_MONTHS[int(month)]}-1"
        for year, month, count in erfa.leap_seconds.get().tolist()
        if year >= 1972
    ]
    return text_kernel(
        "LSK",
        "Leap seconds by the table of ERFA.",
        "DELTET/DELTA_T_A = 32.184",
        "DELTET/K         = 1.657D-3",
        "DELTET/EB        = 1.671D-2",
        "DELTET/M         = ( 6.239996D0 1.99096871D-7 )",
        "DELTET/DELTA_AT  = (",
        *steps,
        ")",
    )


def text_kernel(kind: str, about: str, *lines: str) -> str:
    """Text of a SPICE kernel of a kind, such as `LSK`, with a comment line and its data."""
    body = "\n".join(lines)
    return f"KPL/{kind}\n\n{about}\n\n\\begindata\n\n{body}\n\n\\begintext\n"
