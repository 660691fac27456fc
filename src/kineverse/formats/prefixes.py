"""What is put in front of the names of a file."""

from __future__ import annotations

from kineverse.errors import ExpressionError, FormatError
from kineverse.symbols import position


def check_prefix(prefix: object) -> None:
    """Refuse what cannot be put in front of names.

    Raises
    ------
    FormatError
        With what is wrong with it.
    """
    if prefix is None or prefix == "":
        return
    if not isinstance(prefix, str):
        raise FormatError(f"A prefix is a text that is put in front of names, not {prefix!r}.")
    try:
        position(prefix)
    except ExpressionError:
        raise FormatError(
            f"The prefix {prefix!r} has an empty part, a control character or half of a surrogate pair. The "
            "slash behind it comes by itself."
        ) from None
