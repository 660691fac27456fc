"""Loop closures of a description: solved where possible, else kept as constraints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from kineverse.errors import FormatError, KineverseError, NoSolutionError, list_some
from kineverse.expressions.expression import Expression, array
from kineverse.loops.close_loop import APART, CloseLoop, LoopConstraint
from kineverse.loops.equations import residual_rows
from kineverse.loops.loop_records import find_loops
from kineverse.model.basic_operations import SetHome
from kineverse.model.edit import Edit
from kineverse.model.model_view import ModelView
from kineverse.model.operation import Operation
from kineverse.model.projection import project
from kineverse.model.registry import LoopTreatment
from kineverse.model.sampling import StateSamples
from kineverse.state import State
from kineverse.symbols import Symbol

from .reader_warnings import warn

CLOSED = 1e-6  # largest gap of a loop that counts as closed [m], [rad]: files have six digits

_LOOKED_AT = 12
_MOVED = 1e-6
_SHOWN = 6


@dataclass
class LoopClosures:
    """Application of the operations of a description, with the requested treatment of its loops."""

    edit: Edit
    model: ModelView  # the model that it edits
    source: str  # name of the file, for warnings
    element: str  # element that closes a loop in the format: joint or equality
    loops: LoopTreatment  # "solve": dependent coordinates become a function of the free ones
    kept: list[str] = field(default_factory=list)  # names of the loops that are kept as constraints
    homes: list[tuple[str, tuple[float, ...]]] = field(default_factory=list)

    def apply(self, tag: str, operation: Operation) -> Iterator[str]:
        """Apply an operation, and yield its tag unless it is left out."""
        if isinstance(operation, SetHome):
            self.homes.append((operation.name, operation.home))
        if not isinstance(operation, CloseLoop):
            yield self.edit.apply(operation, tag)
        elif self.loops == "constraint" or operation.dependent == ():
            yield from self._keep(tag, operation, None)
        else:
            try:
                yield self.edit.apply(operation, tag)
            except KineverseError as error:
                yield from self._not_solved(tag, operation, error)

    def _not_solved(self, tag: str, loop: CloseLoop, error: KineverseError) -> Iterator[str]:
        """Close a loop without constant rows that rounding leaves open, or keep it as a constraint."""
        mask = self._moving_rows(loop)
        if mask and mask != loop.mask:
            loop = replace(loop, mask=mask)
            try:
                yield self.edit.apply(loop, tag)
            except KineverseError as other:
                error = other
            else:
                self._tell(loop, "ties what is nearly in one plane: that is taken to be exact")
                return
        yield from self._keep(tag, loop, error)

    def _keep(self, tag: str, loop: CloseLoop, error: KineverseError | None) -> Iterator[str]:
        """Keep a loop as a constraint; leave it out if it is redundant or can never hold."""
        gaps = self._gaps(loop)
        name = _shown(loop.name)
        if len(gaps) and gaps.max() <= CLOSED:
            self._tell(loop, "is left out: it adds nothing, since what it connects coincides in every state")
            return
        if error is not None and self.loops == "refuse":
            raise FormatError(
                f"{self.source}: the {self.element} '{name}' closes a loop, which cannot be followed here: "
                f"{error} Remove the {self.element}, and close the loop with kv.CloseLoop; or keep it as a "
                'constraint, with loops="solve".'
            ) from error
        if not any(row.symbols for rows in self._rows(loop) for row in rows.values()):
            self._tell(
                loop,
                f"is left out, and never holds: nothing moves what it connects, and {gaps.max():.3g} is left "
                "between its ends",
            )
            return
        mask = self._moving_rows(loop) or loop.mask
        yield self.edit.apply(
            LoopConstraint(name=loop.name, frame=loop.frame, to=loop.to, mask=mask, more=loop.more), tag
        )
        self.kept.append(loop.name)
        if error is not None:
            self._tell(
                loop,
                f"closes a loop, which cannot be followed here: {error} So its coordinates stay free, and it "
                f"is the constraint '{loop.name}': model.project(state) moves a state to where it holds",
            )
        elif self.loops == "constraint":
            self._tell(loop, f"closes a loop, and is the constraint '{loop.name}', as asked for")

    def finish(self) -> Iterator[str]:
        """Move the default state to where the kept loops close, if possible; yield the tags of these edits.

        Warns about coordinates that differ from the home of the description.
        """
        moved: dict[Symbol, tuple[float, float]] = {}
        if self.kept:
            yield from self._close_home(moved)
        if self.homes:
            state = self.model.default_state()
            for name, home in self.homes:
                for symbol, value in zip(self.model.articulations[name].coordinates, home, strict=False):
                    now = self._at_home(symbol, state)
                    if now is not None and abs(now - value) > _MOVED:
                        moved[symbol] = value, now
        if moved:
            shown = list_some((f"'{s}' from {a:.6g} to {b:.6g}" for s, (a, b) in moved.items()), _SHOWN)
            warn([f"{self.source}: its home is moved to where limits and loops hold: {shown}."])

    def _close_home(self, moved: dict[Symbol, tuple[float, float]]) -> Iterator[str]:
        """Move the home of coordinates to where kept loops close; add old and new values to ``moved``."""
        state = self.model.default_state()
        wanted = {
            name for loop in find_loops(self.model) if loop.name in self.kept for name in loop.constraints
        }
        broken = [v for v in self.model.violations(state) if v.name in wanted]
        if not broken:
            return
        try:
            found = project(self.model.select_equalities(wanted), state)
        except NoSolutionError as error:
            warn([f"{self.source}: loops that were kept as constraints are open at default_state(). {error}"])
            return
        changed = {s: (value, found[s]) for s, value in state.items() if found[s] != value}
        for name, record in list(self.model.articulations.items()):
            if changed.keys() & set(record.coordinates):
                pairs = zip(record.coordinates, record.home, strict=True)
                home = tuple(found.get(s, value) for s, value in pairs)
                yield self.edit.apply(SetHome(name, home), f"closed home {name}")
        moved |= {s: ends for s, ends in changed.items() if abs(ends[1] - ends[0]) > _MOVED}

    def _at_home(self, symbol: Symbol, state: State) -> float | None:
        if symbol in state:
            return state[symbol]
        follows = self.model.rates.dependent.get(symbol)
        try:
            return None if follows is None else float(follows(state))
        except NoSolutionError:
            return None

    def _moving_rows(self, loop: CloseLoop) -> tuple[str, ...]:
        """Return the mask of a loop without rows that are constant and zero but for rounding in the file."""
        all_rows = self._rows(loop)
        still = [axis for axis in loop.mask if not any(rows[axis].symbols for rows in all_rows)]
        gaps = {axis: max(abs(float(rows[axis])) for rows in all_rows) for axis in still}
        return tuple(axis for axis in loop.mask if not APART < gaps.get(axis, 0.0) <= CLOSED)

    def _rows(self, loop: CloseLoop) -> list[dict[str, Expression]]:
        rates = self.model.rates
        return [
            residual_rows(rates.resolve(self.model.fk(frame, to)), loop.mask)
            for frame, to in ((loop.frame, loop.to), *loop.more)
        ]

    def _gaps(self, loop: CloseLoop) -> npt.NDArray[np.float64]:
        """Return the norm of the residual in sampled states within limits, where other loops close."""
        rows = array([row for rows in self._rows(loop) for row in rows.values()])
        (values,) = StateSamples(self.model, count=_LOOKED_AT).values([rows])
        gaps = np.linalg.norm(values, axis=1)
        result: npt.NDArray[np.float64] = gaps[np.isfinite(gaps)]
        return result

    def _tell(self, loop: CloseLoop, text: str) -> None:
        warn([f"{self.source}: the {self.element} '{_shown(loop.name)}' {text}."])


def _shown(name: str) -> str:
    return name.removesuffix("/loop")
