"""Optional packages: a check for missing ones, with the command that installs them."""

from importlib.util import find_spec

from service.errors import Fault, NotAvailable, shown_value


def require_extra(extra: str, package: str, field: str, value: str) -> None:
    """Raise `NotAvailable` unless a package of an extra is installed.

    Without `package` nothing is needed.
    """
    if package and find_spec(package) is None:
        message = (
            f"needs the package {package}; install it with: "
            f"pip install 'attitude-acquisition[{extra}]'"
        )
        raise NotAvailable(Fault(field, message, shown_value(value)))
