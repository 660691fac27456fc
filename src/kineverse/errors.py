"""Exceptions of the library and the parts of their messages.

All of them derive from :class:`KineverseError`, and also from the corresponding built-in error (``KeyError``,
``ValueError`` ...). A message names the mistake, its place, the alternatives and the correction.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

__all__ = [
    "CompileError",
    "ConflictError",
    "DuplicateNameError",
    "EditError",
    "ExpressionError",
    "ForbiddenError",
    "FormatError",
    "InfeasibleError",
    "InvalidValueError",
    "KineverseError",
    "MissingDependencyError",
    "ModelError",
    "NoSolutionError",
    "NotFiniteError",
    "OfflineError",
    "ShapeError",
    "SimulationError",
    "StoppedError",
    "UnknownAttributeError",
    "UnknownNameError",
    "suggest",
]


class KineverseError(Exception):
    """Base of all errors of this package.

    Examples
    --------
    >>> try:
    ...     kv.load("kitchn")
    ... except kv.KineverseError as error:
    ...     print(str(error).splitlines()[0])
    There is no model 'kitchn'. Did you mean 'kitchen'?...
    """

    def __str__(self) -> str:
        # KeyError prints the repr of its argument; the message is printed as it is.
        return str(self.args[0]) if len(self.args) == 1 else super().__str__()

    def __reduce__(self) -> tuple[Any, ...]:
        # Constructors of subclasses take other arguments than the text, so a pickle does without them.
        return _restore_error, (type(self), self.args, self.__dict__)


def _restore_error(
    kind: type[KineverseError], args: tuple[Any, ...], attributes: dict[str, Any]
) -> KineverseError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(attributes)
    return error


class UnknownNameError(KineverseError, KeyError):
    """A frame, symbol, constraint, tag or model of that name does not exist.

    Everything that takes a name raises it, and lists similar names.

    Examples
    --------
    >>> kv.load("kitchen").fk("kitchen/fridge_dor")
    Traceback (most recent call last):
        ...
    kineverse.errors.UnknownNameError: There is no frame 'kitchen/fridge_dor'. Did you mean ...
    """


class DuplicateNameError(KineverseError, ValueError):
    """A name, tag or constraint is in use already: of a frame or articulation for each new one.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> with model.edit() as edit:
    ...     edit.add_frame("kitchen/fridge_door", parent="world")
    Traceback (most recent call last):
        ...
    kineverse.errors.DuplicateNameError: There is a frame 'kitchen/fridge_door' already, written by ...
    """


class ShapeError(KineverseError, ValueError):
    """Operands, arrays or matrices have incompatible shapes.

    Examples
    --------
    >>> kv.array([1, 2, 3]) + kv.array([kv.position("x"), 2])
    Traceback (most recent call last):
        ...
    kineverse.errors.ShapeError: Shapes (3,) and (2,) cannot be broadcast together.
    """


class InvalidValueError(KineverseError, ValueError):
    """A value is outside of its domain: NaN, an empty range, an axis of length zero ...

    Examples
    --------
    >>> kv.axis_angle((0, 0, 0), 1.0)
    Traceback (most recent call last):
        ...
    kineverse.errors.InvalidValueError: The axis of a rotation has length zero.
    """


class ExpressionError(KineverseError, TypeError):
    """An expression is used in a way that is not defined (such as ``if expression:``).

    Examples
    --------
    >>> bool(kv.position("x") < 1)
    Traceback (most recent call last):
        ...
    kineverse.errors.ExpressionError: An expression has no truth value. Write (0.4 < b) & (b < 0.6) ...
    """


class CompileError(KineverseError, RuntimeError):
    """Expressions cannot be compiled to a function.

    Examples
    --------
    >>> kv.compile([])
    Traceback (most recent call last):
        ...
    kineverse.errors.CompileError: There is no output to compile.
    """


class NoSolutionError(KineverseError, ValueError):
    """A closed loop, or another implicit function, has no solution at the values given.

    See Also
    --------
    kineverse.loops.solve_loop
    kineverse.CloseLoop
    """


class ModelError(KineverseError, ValueError):
    """A model would be inconsistent: cyclic frames, cyclic rates, rates by undefined symbols.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.add_frame("a", parent="world")
    ...     edit.attach("a", parent="a", transform=np.eye(4))
    Traceback (most recent call last):
        ...
    kineverse.errors.ModelError: Cyclic frames: 'a' would be its own parent.
    """


class EditError(KineverseError, RuntimeError):
    """An edit failed, and the model is unchanged.

    Attributes
    ----------
    failures
        The errors of operations that cannot be applied, by tag.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> with model.edit() as edit:
    ...     edit.remove("joint kitchen/fridge_door")
    Traceback (most recent call last):
        ...
    kineverse.errors.EditError: The edit is refused, because these operations cannot be applied:...
    """

    def __init__(self, message: str, failures: Mapping[str, KineverseError] | None = None) -> None:
        super().__init__(message)
        self.failures: dict[str, KineverseError] = dict(failures or {})


class ConflictError(EditError):
    """An edit of a live model met one that others have made meanwhile, and nothing was done.

    Attributes
    ----------
    tags, paths
        Operations and values in which the two meet.
    revision, who
        Version of the other edit, and who has made it.

    See Also
    --------
    kineverse.exchange.LiveModel
    """

    def __init__(
        self,
        message: str,
        tags: Iterable[str] = (),
        paths: Iterable[str] = (),
        revision: int = 0,
        who: str = "",
    ) -> None:
        super().__init__(message)
        self.tags, self.paths = tuple(tags), tuple(paths)
        self.revision, self.who = revision, who


class ForbiddenError(EditError):
    """The right of this user does not allow it, and nothing was done; the message says what it allows.

    See Also
    --------
    kineverse.exchange.serve
    """


class OfflineError(KineverseError, ConnectionError):
    """The server of a live model does not answer; the model can be read on, and edits are not possible.

    See Also
    --------
    kineverse.exchange.LiveModel
    """


class UnknownAttributeError(KineverseError, AttributeError):
    """An object has no such attribute; the message lists similar names.

    Examples
    --------
    >>> kv.Model().forward_kinematics
    Traceback (most recent call last):
        ...
    kineverse.errors.UnknownAttributeError: A model has no 'forward_kinematics'. Here that is ...
    """


class FormatError(KineverseError, ValueError):
    """A file or document does not follow its format.

    Examples
    --------
    >>> with open("door.urdf", "w", encoding="utf-8") as file:
    ...     size = file.write("<robot name='door'><link>")
    >>> kv.load("door.urdf")
    Traceback (most recent call last):
        ...
    kineverse.errors.FormatError: door.urdf, line 1, column 26, in <link> of line 1: not well-formed ...
    """


class SimulationError(KineverseError, RuntimeError):
    """A simulation has come to a state that is not to be trusted; its world has to be reset.

    See Also
    --------
    kineverse.worlds.MujocoWorld
    """


class StoppedError(KineverseError, RuntimeError):
    """A robot takes no commands until people release it: an emergency stop, or a protective one.

    See Also
    --------
    kineverse.live.WorldProcess
    """


class InfeasibleError(KineverseError, ValueError):
    """No command satisfies all hard constraints of a controller.

    Attributes
    ----------
    conflict
        An irreducible set of contradictory constraints, each with ``name``, ``operations``, ``lower`` and
        ``upper``: without any of them the others can be satisfied.
    command
        The command that violates the rows least, within the limits of single speeds.

    See Also
    --------
    kineverse.control.Keep
    kineverse.control.Controller
    """

    def __init__(self, message: str, conflict: Sequence[Any] = (), command: Any = None) -> None:
        super().__init__(message)
        self.conflict: tuple[Any, ...] = tuple(conflict)
        self.command = command


class NotFiniteError(KineverseError, ArithmeticError):
    """A value or derivative is NaN or infinite at a state.

    Attributes
    ----------
    names
        The tasks and constraints with such values.

    See Also
    --------
    kineverse.Model.violations
    kineverse.control.Controller
    """

    def __init__(self, message: str, names: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.names: tuple[str, ...] = tuple(names)


class MissingDependencyError(KineverseError, ImportError):
    """An optional dependency is not installed; the message names the extra that brings it.

    See Also
    --------
    kineverse.to_jax
    kineverse.to_torch
    kineverse.show
    """


def duplicate_value_error(symbol: object) -> DuplicateNameError:
    """Return the error for a symbol with one value by symbol and another by name."""
    return DuplicateNameError(
        f"There are two values for '{symbol}', by symbol and by name. "
        f"Instead of {{**state, '{symbol}': ...}} write state.updated({{'{symbol}': ...}})."
    )


def summarize_error(error: Exception, advice: bool = True) -> str:
    """Return the first line of an error's message, without the places in which a file was looked for.

    Without a message it is the name of the error's type; without ``advice``, no variable to set is named.
    """
    text = str(error).strip()
    if not advice:
        text = re.split(r" (?:Looked|Set) ", text, maxsplit=1)[0]
    first = (text.splitlines() or [type(error).__name__])[0]
    return re.sub(r" (?:Looked (?:in|for)|It is at):$", "", first).strip()


_LONGEST = 100


def list_some(texts: Iterable[object], most: int) -> str:
    """Return the first of some texts, and how many others there are: ``a, b and 3 more``."""
    listed = list(map(str, texts))
    more = f" and {len(listed) - most} more" if len(listed) > most else ""
    return ", ".join(listed[:most]) + more


def suggest(name: str, available: Iterable[str], what: str = "name", limit: int = 12) -> str:
    """Return the part of an error message that lists similar names, or the available ones.

    Parameters
    ----------
    available
        The known names.
    what
        The noun for the names.
    limit
        The largest number of listed names.

    Examples
    --------
    >>> kv.errors.suggest("fridge_dor", ["fridge_door", "oven_door", "sink"])
    "Did you mean 'fridge_door'?"
    """
    import difflib  # for start-up time

    names = sorted(set(available))
    if not names:
        return f"There is no {what} at all."
    # Longer names have no similar ones, and take long to compare.
    close = difflib.get_close_matches(name[:1000], names, n=4, cutoff=0.6) if len(names) <= 20_000 else []
    parts = (n for n in names if n.endswith(f"/{name}") or n.startswith((f"{name}/", f"{name}:")))
    close += [n for n in parts if n not in close][: max(0, 4 - len(close))]
    if close:
        return f"Did you mean {' or '.join(_shorten(repr(n)) for n in close)}?"
    return f"Available: {list_some(map(_shorten, names), limit)}."


def unknown_attribute_error(
    owner: str,
    name: str,
    available: Iterable[str],
    elsewhere: Mapping[str, str],
    below: Mapping[str, str] | None = None,
) -> UnknownAttributeError:
    """Return the error for an unknown attribute, with similar names or the equivalent of a foreign name.

    ``owner`` is the subject of a sentence; ``elsewhere`` leads from names of other libraries to their
    equivalents here, ``below`` from names in packages below the object to their full names.
    """
    import difflib

    below = below or {}
    problem = f"{owner} has no {name!r:.80}."
    if name.startswith("_"):
        return UnknownAttributeError(problem)
    public = sorted({one for one in available if not one.startswith("_")})
    by_lower: dict[str, str] = {one.lower(): place for one, place in below.items()}
    by_lower |= {one.lower(): one for one in public}
    lower = name.lower()
    foreign = {one.lower(): answer for one, answer in elsewhere.items()}
    answer = elsewhere.get(name) or below.get(name) or (None if lower in by_lower else foreign.get(lower))
    if answer:
        return UnknownAttributeError(f"{problem} Here that is {answer}.")
    matches = [lower] if lower in by_lower else difflib.get_close_matches(lower, by_lower, n=3, cutoff=0.6)
    close = [by_lower[match] for match in matches]
    if close:
        return UnknownAttributeError(f"{problem} Did you mean {' or '.join(map(repr, close))}?")
    return UnknownAttributeError(f"{problem} dir(...) lists what there is.")


def _shorten(name: str) -> str:
    return name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}…"
