"""Parts and the whole model: how they are compared, and replicas that follow a view."""

from __future__ import annotations

from collections.abc import Iterable

import kineverse as kv
from kineverse.exchange.protocol import Changes, decode_changes
from kineverse.exchange.views import Coupling, View, Wish
from kineverse.formats.document import from_bytes, to_bytes
from kineverse.model.model import Snapshot
from kineverse.model.operation import Cell


def close(model: kv.Model, wish: Wish) -> set[Cell]:
    """Return the cells, by kind and name, that the part of a wish has."""
    return {*Coupling(model.history).close(wish)[0]}


def make_replica(view: View) -> kv.Model:
    """Return the part that a client gets when it joins."""
    return from_bytes(to_bytes(Snapshot({}, view.entries, 0)))


def adopt(replica: kv.Model, changes: Changes) -> None:
    """Make the changes of a view in a replica, as a client does."""
    replica.adopt(decode_changes(changes))


def check_agreement(
    whole: kv.Model, part: kv.Model, frames: Iterable[str], symbols: Iterable[str] = (), rows: bool = True
) -> None:
    """Check all that a part promises about the wished frames and symbols, and about its coordinates."""
    for frame in frames:
        assert part.fk(frame) == whole.fk(frame), frame
        assert part.symbols_of(frame) == whole.symbols_of(frame), frame
        assert part.speeds_of(frame) == whole.speeds_of(frame), frame
        assert part.jacobian(frame) == whole.jacobian(frame), frame
        assert part.constraints_for(frame) == whole.constraints_for(frame), frame
        if rows:
            check_rows(whole.velocity_rows(0.01, frame), part.velocity_rows(0.01, frame))
    for name in symbols:
        symbol = kv.position(name)
        assert part.constraints_for(symbol) == whole.constraints_for(symbol), name
        check_rows(whole.velocity_rows(0.01, symbol), part.velocity_rows(0.01, symbol))
    assert {*part.symbols} <= {*whole.symbols}
    assert {*part.speeds} <= {*whole.speeds}
    assert part.rates.dependent.items() <= whole.rates.dependent.items()
    assert all(whole.rates[symbol] == row for symbol, row in part.rates.items())
    default, expected = part.default_state(), whole.default_state()
    for symbol in part.symbols:
        assert default[symbol] == expected[symbol], symbol
        assert part.symbol(str(symbol)) is symbol
        assert part.limits(symbol) == whole.limits(symbol), symbol
        assert part.limits(symbol, default) == whole.limits(symbol, expected), symbol
        assert part.constraints_for(symbol) == whole.constraints_for(symbol), symbol
    for speed in part.speeds:
        assert part.limits(speed) == whole.limits(speed), speed


def check_rows(rows: kv.model.VelocityRows, others: kv.model.VelocityRows) -> None:
    """Check that velocity rows are equal."""
    assert rows.names == others.names
    assert rows.speeds == others.speeds
    assert rows.skipped == others.skipped
    assert rows.matrix == others.matrix
    assert rows.lower == others.lower
    assert rows.upper == others.upper
