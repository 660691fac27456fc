"""Model a rocker switch: it tilts between two rests, and a snap spring drives it from the middle to either.

The torque of the spring is τ(q) = c q (1 - q²/r²). It vanishes at 0 and at ±r. An equilibrium is stable
where the slope of the torque is negative: at the two rests.
"""

import kineverse as kv

q = kv.position("switch")
c, rest = 0.4, 0.2  # [N m/rad], [rad]
torque = c * q * (1 - (q / rest) ** 2)
model = kv.Model()
with model.edit() as edit:
    edit.apply(kv.Revolute(name="switch", parent="world", child="rocker", lower=-0.25, upper=0.25))
    edit.write("switch/torque", torque)
    edit.write("switch/is_on", q > 0)

slope = torque.jacobian([q])[0]
for angle in (-rest, 0.0, rest):
    print(angle, "stable" if slope({q: angle}) < 0 else "unstable", "on" if angle > 0 else "off")

for pressed in (-0.05, 0.05):  # [rad]
    state = model.default_state().updated({q: pressed})
    for _ in range(200):  # strongly damped: the speed is proportional to the torque
        state = model.integrate(state, {q.derivative(): 10 * torque(state)}, dt=0.01)
    print(f"released at {pressed}: rests at {state[q]:.3f}, on: {model.data['switch/is_on'](state):.0f}")
