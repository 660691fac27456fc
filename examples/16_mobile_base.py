"""Drive a differential-drive base: poses depend on coordinates, but only wheel speeds can move them."""

import kineverse as kv

robot = kv.Model()
with robot.edit() as edit:
    edit.apply(
        kv.articulations.DifferentialDrive(name="base", parent="world", child="base", radius=0.1, track=0.5)
    )
    edit.add_frame("camera", parent="base", transform=kv.translation(0.2, 0, 0.5))

print(robot.degrees_of_freedom)
print(robot.speeds)
for speed, expression in robot.fk("camera")[0, 3].gradient().items():  # its x, by wheel speed
    print(speed, expression)

state = robot.default_state()
speeds = {"base/left_wheel:velocity": 4.0, "base/right_wheel:velocity": 6.0}  # [rad/s]
for _ in range(10):
    state = robot.integrate(state, speeds, dt=0.2)
print({str(symbol): round(state[symbol], 3) for symbol in robot.degrees_of_freedom})
