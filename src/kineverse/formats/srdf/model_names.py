"""Links and joints of a semantic description, found in a model."""

from __future__ import annotations

from collections.abc import Mapping

from kineverse.errors import UnknownNameError, suggest
from kineverse.formats.xml_reader import Element, ElementError, label, quote
from kineverse.model.articulation import Articulation
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView

_MOST_SUGGESTIONS = 50  # unknown names for which similar ones are looked up, which takes a while


class ModelNames:
    """Frames and articulations of a robot in a model, by their names in its files."""

    def __init__(self, model: ModelView, prefix: str) -> None:
        self._frames = dict(model.frames)
        self.prefix = f"{prefix}/" if prefix else ""  # with its slash
        self._free = {str(s) for s in model.degrees_of_freedom}
        self.articulations: Mapping[str, Articulation] = dict(model.articulations)
        self._above = {a.child: name for name, a in self.articulations.items()}
        self._near: dict[tuple[str, str], str] = {}
        self._sought: dict[str, bool] = {}

    def link(self, element: Element, key: str) -> str:
        """Return the frame of the link that an attribute names."""
        return self._find(element, key, "link", self._frames)

    def joint(self, element: Element, key: str = "name") -> str:
        """Return the articulation of the joint that an attribute names."""
        return self._find(element, key, "joint", self.articulations)

    def joint_above(self, link: str) -> str | None:
        """Return the articulation that has a frame as its child; None if there is none."""
        return self._above.get(link)

    def moving_joint_above(self, link: str) -> str | None:
        """Return the nearest articulation that moves a frame; None if there is none."""
        for frame in self._ancestors(link):
            joint = self._above.get(frame)
            if joint is not None and self.is_moving(joint):
                return joint
        return None

    def is_moving(self, joint: str) -> bool:
        """Return whether an articulation moves: it has coordinates, or follows others."""
        record = self.articulations[joint]
        return bool(record.coordinates or record.speeds or record.follows is not None)

    def free_coordinates(self, joint: str) -> list[str]:
        """Return the names of the free coordinates of an articulation."""
        return [str(s) for s in self.articulations[joint].coordinates if str(s) in self._free]

    def chain(self, base: str, tip: str) -> tuple[list[str], list[str]]:
        """Return the frames between two frames, both included, and the articulations between them.

        The way goes up from the base to the common ancestor and down to the tip.
        """
        up, down = self._ancestors(base), self._ancestors(tip)
        on_the_way_up = set(up)
        shared = next((frame for frame in down if frame in on_the_way_up), None)
        if shared is None:
            raise UnknownNameError(f"'{base}' and '{tip}' are joined by nothing but the world")
        rising, falling = up[: up.index(shared)], down[: down.index(shared)][::-1]
        frames = [*rising, shared, *falling]
        joints = [j for frame in (*rising, *falling) if (j := self._above.get(frame)) is not None]
        return frames, joints

    def check_robot(self, source: str) -> None:
        """Raise an UnknownNameError if nothing that was sought is in the model: the prefix is another one."""
        if not self._sought or any(self._sought.values()):
            return
        first, known = next(iter(self._sought)), {*self._frames, *self.articulations}
        prefixes = sorted(name.removesuffix(f"/{first}") for name in known if name.endswith(f"/{first}"))
        prefixes += [""] if first in known else []
        hint = (
            f"There is one below prefix {' and below '.join(map(repr, prefixes[:4]))}: give it as prefix=."
            if prefixes
            else suggest(self.prefix + first, known, "link or joint")
        )
        raise UnknownNameError(
            f"{source}: the model has no link or joint of this description below the prefix "
            f"'{self.prefix.rstrip('/')}', such as {quote(first)}. {hint}"
        )

    def _ancestors(self, frame: str) -> list[str]:
        result = []
        while frame != WORLD:
            result.append(frame)
            frame = self._frames[frame].parent
        return result

    def _find(self, element: Element, key: str, what: str, known: Mapping[str, object]) -> str:
        said = required(element, key)
        name = self.prefix + said
        self._sought[said] = self._sought.get(said, False) or name in known
        if name in known:
            return name
        if (what, said) not in self._near and len(self._near) < _MOST_SUGGESTIONS:
            below = [name[len(self.prefix) :] for name in known if name.startswith(self.prefix)]
            self._near[what, said] = f" ({suggest(said, below, what).rstrip('.')})"
        hint = self._near.get((what, said), "")
        raise ElementError(element, f"{quote(said)} is no {what} of the model{hint}.")


def optional(element: Element, key: str) -> str:
    """Return an attribute of an element without blanks around it, as MoveIt takes names; empty if missing."""
    return element[1].get(key, "").strip()


def required(element: Element, key: str) -> str:
    """Return an attribute of an element without blanks around it."""
    said = optional(element, key)
    if not said:
        raise ElementError(element, f"has no {key}; {label(element).split()[0].strip('<>')} needs one.")
    return said
