"""Names of a model and those of ROS: a list of rules that translates both ways."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from kineverse.errors import DuplicateNameError, InvalidValueError, UnknownNameError, suggest

TF = "tf:"
"""Begins the source of a pose that is a frame of TF, and no topic."""

_TOPIC = re.compile(r"(~?/)?([A-Za-z_]\w*/)*[A-Za-z_]\w*", re.ASCII)


class NameMap:
    """Names of ROS by names of a model, for joints or for frames.

    Parameters
    ----------
    names
        Names in the model.
    rules
        Names of ROS by names of the model. A name that ends in ``/`` stands for all below it:
        ``{"pr2/": ""}`` takes the prefix away. The longest rule counts. Names without a rule are the same.
    prefix
        Is put before all names of ROS.

    Raises
    ------
    UnknownNameError
        For a rule that names nothing of the model.
    DuplicateNameError
        If two names would be the same in ROS.
    InvalidValueError
        If a name would be empty or begin with a slash, which ROS refuses.
    """

    def __init__(self, names: Iterable[str], rules: Mapping[str, str], prefix: str = "") -> None:
        self._to_ros: dict[str, str] = {}
        self._to_model: dict[str, str] = {}
        unused = set(rules)
        known = list(names)
        for name in known:
            key = max((key for key in rules if covers(key, name)), key=len, default=None)
            unused.discard(key or "")
            other = prefix + (name if key is None else rules[key] + name[len(key) :])
            if not other or other.startswith("/"):
                raise InvalidValueError(
                    f"'{name}' would be '{other}' in ROS, where a name is not empty and begins with no slash."
                )
            if other in self._to_model:
                raise DuplicateNameError(
                    f"'{self._to_model[other]}' and '{name}' would both be '{other}' in ROS. Map one of them."
                )
            self._to_ros[name], self._to_model[other] = other, name
        if unused:
            name = min(unused)
            raise UnknownNameError(
                f"The map of names has '{name}', which names nothing. {suggest(name, known)}"
            )

    def to_ros(self, name: str) -> str:
        """Return the name in ROS of a name of the model."""
        return self._to_ros[name]

    def translate(self, name: str) -> str:
        """Return the name in ROS of a name of the model, and any other name as it is."""
        return self._to_ros.get(name, name)

    def to_model(self, name: str) -> str | None:
        """Return the name in the model of a name of ROS; None for one of something else."""
        return self._to_model.get(name)


def check_topics(topics: Iterable[str]) -> None:
    """Check names of topics; ROS has its own words for those that it refuses.

    Raises
    ------
    InvalidValueError
        For a name that no topic can have.
    """
    for topic in topics:
        if _TOPIC.fullmatch(topic) is None:
            raise InvalidValueError(
                f"'{topic}' is no name of a topic in ROS: words of letters, digits and _, with slashes "
                "between them."
            )


def covers(key: str, name: str) -> bool:
    """Return True if a key names something: by its name, or with a slash at the end by what it is below."""
    return name == key or (key.endswith("/") and name.startswith(key))
