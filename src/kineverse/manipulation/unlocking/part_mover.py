"""Motion of one part of a mechanism by the velocity controller, while all other parts are held."""

from __future__ import annotations

from kineverse._checks import finite_number
from kineverse.control import Controller, Goal
from kineverse.errors import InvalidValueError
from kineverse.manipulation.session import Session
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol, parameter

TOLERANCE = 1e-4
"""Distance from a target at which it is reached [m] or [rad]."""
_TARGET = "unlocking/target"


class PartMover:
    """Drive of single coordinates to positions.

    The tasks are a goal for the coordinate, and all others still; the constraints of the model are rows.

    Parameters
    ----------
    model
        Model of the parts as far as it is known.
    session
        Session in a world whose coordinates are driven, such as :class:`kineverse.worlds.MechanismWorld`.
    patience
        Time without progress after which a coordinate counts as stuck [s].
    speed
        Largest speed [m/s] or [rad/s]; limits of the model count as well.

    Raises
    ------
    InvalidValueError
        For a patience or a speed that is not positive.
    """

    def __init__(
        self, model: ModelView, session: Session, *, patience: float = 1.0, speed: float = 0.4
    ) -> None:
        for what, number in (("patience", patience), ("speed", speed)):
            if not (finite_number(number) or 0.0) > 0:
                raise InvalidValueError(f"The {what} of a moved part is a positive number, not {number!r}.")
        self.model, self.session = model, session
        self._patience, self._speed = float(patience), float(speed)
        self._target = parameter(_TARGET, 0.0)
        self._controllers: dict[Symbol, Controller] = {}

    def move(self, coordinate: Symbol | str, target: float, tolerance: float = TOLERANCE) -> float:
        """Move a coordinate to a target, and return the position where it ends [m] or [rad].

        It ends within the tolerance of the target, or where it has come no nearer for the patience.

        Raises
        ------
        UnknownNameError
            For a name that is no degree of freedom.
        """
        symbol = self.model.degree_of_freedom(coordinate)
        controller, session = self._controller(symbol), self.session
        controller.reset()
        controller.set(self._target, target)
        start = nearest = session.state[symbol]
        session.phase = f"{'raise' if target > start else 'lower'} {symbol}"
        since = session.world.time
        while abs(session.state[symbol] - target) > tolerance:
            with session.timed("unlock"):
                command = controller.step(session.state)
            session.act(command.speeds, command)
            here = session.state[symbol]
            if abs(here - target) < abs(nearest - target) - tolerance:
                nearest, since = here, session.world.time
            elif session.world.time - since > self._patience:
                break
        return session.state[symbol]

    def _controller(self, symbol: Symbol) -> Controller:
        """Return the controller that moves a coordinate."""
        if symbol not in self._controllers:
            goal = Goal(
                symbol, self._target, name=f"move {symbol}", gain=0.5 / self.session.dt, speed=self._speed
            )
            others = [s for s in self.model.degrees_of_freedom if s != symbol]
            self._controllers[symbol] = Controller(
                self.model, [goal], dt=self.session.dt, still=others, smooth=1e-3, posture=0.0
            )
        return self._controllers[symbol]
