"""Model an ironing board: two crossed legs, one of which slides in a rail below the board, close a loop.

The place of the slider in the rail determines both angles, and so the height of the board.
"""

import kineverse as kv

model = kv.Model()
with model.edit() as edit:
    edit.apply(kv.Prismatic(name="slider", parent="world", child="slider", lower=0.3, upper=0.9))
    for leg, parent, low, high in (("front", "world", 0, 1.5), ("rear", "slider", 1.5, 3.14)):
        edit.apply(kv.Revolute(name=leg, parent=parent, child=leg, axis=(0, 1, 0), lower=low, upper=high))
        edit.add_frame(f"{leg}_pivot", parent=leg, transform=kv.translation(0.55, 0, 0))
        edit.add_frame(f"{leg}_foot", parent=leg, transform=kv.translation(1.1, 0, 0))
    legs = {"front": 1.0, "rear": 2.1}  # near which the loop closes [rad]
    edit.close_loop(
        "rear_pivot", "front_pivot", name="legs", mask=("x", "z"), dependent=tuple(legs), home=legs
    )

print(model.degrees_of_freedom)
height = -model.fk("front_foot")[2, 3]
for notch in (0.35, 0.5, 0.65, 0.8):  # of the rail
    level = model.fk("rear_foot")({"slider": notch})[2, 3] + height({"slider": notch})
    print(f"notch at {notch} m: height {height({'slider': notch}):.3f} m, level: {abs(level) < 1e-9}")
print(height.jacobian(model.degrees_of_freedom)({"slider": 0.5}).round(3), "m of height per m of the slider")
