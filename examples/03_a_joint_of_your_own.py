"""Write a joint that has no name: a garage door that slides up while it tilts, and a bolt that locks it."""

import numpy as np

import kineverse as kv

a, b = kv.position("garage/door"), kv.position("garage/bolt")
unlocked = ~((b < 0.3) & (a > 1.99))  # the door is open, or the bolt is raised

model = kv.Model()
with model.edit() as edit:
    swing = kv.translation(0, 0, 2 - a) @ kv.rotation_y(np.arccos(a / 2))
    edit.add_frame("garage/door", parent="world", transform=swing)
    edit.constrain("garage/range", 0, a, 2)  # lower, expression, upper
    edit.constrain("garage/lock", -unlocked, a.derivative(), unlocked)  # of the speed

print(model.fk("garage/door")({a: 1.0}).round(3))
print(sorted(model.constraints_for(model.fk("garage/door"))))
# The augmented gradient of the lock is a direction to try: raise the bolt, or lower a, which lifts the door.
for speed, trend in unlocked.gradient().items():
    print(speed, trend({a: 2, b: 0}).round())
