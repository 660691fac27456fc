"""Read off a model which joint locks which, and in which order to move them."""

import kineverse as kv
from kineverse.articulations import speed_lock
from kineverse.reasoning import interlocks, opening_order

key, bolt, door = (kv.position(f"safe/{name}") for name in ("key", "bolt", "door"))
model = kv.Model()
with model.edit() as edit:
    edit.apply(kv.Revolute(name="safe/key", parent="world", child="key", lower=0, upper=1.57))
    edit.apply(kv.Prismatic(name="safe/bolt", parent="world", child="bolt", lower=0, upper=0.03))
    edit.apply(kv.Revolute(name="safe/door", parent="world", child="door", lower=0, upper=1.5))
    # The bolt moves only while the key is turned, and the closed door only while the bolt is back.
    edit.constrain("safe/key_lock", *speed_lock(bolt, open_if=key > 1.5))
    edit.constrain("safe/bolt_lock", *speed_lock(door, open_if=bolt > 0.02, engaged_if=door < 0.01))

found = interlocks(model)
for lock in found:
    print(lock)
print("order:", [str(symbol) for symbol in opening_order(found, door)])

closed = model.default_state().extended({"safe/door:velocity": 0.1, "safe/bolt:velocity": 0.0})
print(model.violations(closed))
