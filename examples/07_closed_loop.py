"""Close a four-bar linkage: two angles become functions of the third, exact to the second derivative."""

import kineverse as kv


def add_bar(edit, name, parent, x, length, **limits):
    """Add a bar with a hinge at its beginning, and a frame at its end."""
    hinge = kv.translation(x, 0, 0)
    edit.apply(kv.Revolute(name=name, parent=parent, child=name, origin=hinge, axis=(0, 0, 1), **limits))
    edit.add_frame(f"{name}_end", parent=name, transform=kv.translation(length, 0, 0))


model = kv.Model()
with model.edit() as edit:
    add_bar(edit, "crank", "world", 0.0, 0.4)
    add_bar(edit, "coupler", "crank_end", 0.0, 1.1)
    add_bar(edit, "rocker", "world", 1.0, 0.9, lower=0, upper=2)
    edit.close_loop("coupler_end", "rocker_end", name="four_bar", home={"coupler": 1, "rocker": 1.5})

print(model.degrees_of_freedom)
for crank in (0.0, 0.5, 1.0):
    velocity = model.jacobian("rocker_end")({"crank": crank})[:2, 0]
    print(crank, model.fk("rocker_end")({"crank": crank})[:2, 3].round(4), velocity.round(4))
print(model.violations({"crank": -2.0}))  # the limit of the rocker has become a limit of the crank
