"""The run-time check of types and shapes behind the import hook in `conftest`."""

from collections.abc import Callable

from beartype import BeartypeConf, beartype

_check = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is welcome as a float


def checked(function: Callable) -> Callable:
    """`beartype`, which sees methods one at a time, so that `Self` means nothing to it."""
    hints = function.__annotations__
    for name in [name for name, hint in hints.items() if str(hint) in ("Self", "typing.Self")]:
        del hints[name]
    return _check(function)
