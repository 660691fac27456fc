"""Find the constraints of a pose, list the violations of a state, and project onto equality constraints."""

import kineverse as kv

model = kv.load("kitchen")
handle = model.fk("kitchen/fridge_door_handle")
for name, c in model.constraints_for(handle).items():
    print(f"{name}: {c.lower} <= {c.expression} <= {c.upper}")
state = model.default_state().updated({"kitchen/fridge_door": 2.0, "kitchen/oven_left_drawer": -0.1})
print(model.violations(state))

# The bounds of a constraint may be expressions as well.
door, drawer = model.symbol("kitchen/fridge_door"), model.symbol("kitchen/oven_left_drawer")
with model.edit() as edit:
    edit.constrain("clearance", 0, drawer, 0.48 - 0.2 * door)
print(model.violations(state.updated({door: 1.5, drawer: 0.4})))
print([name for name in model.constraints_for([door], bounds=True) if "velocity" not in name])

# Where both bounds are equal, a state can be projected onto the constraint.
a, b = kv.position("a"), kv.position("b")
balance = kv.Model()
with balance.edit() as edit:
    edit.constrain("balance", 1, a + b, 1)
print(balance.project({a: 0.2, b: 0.0}, fixed="a"))
