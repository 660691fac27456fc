"""Compute distances between the bodies of a model, and use one as an expression (extra ``geometry``)."""

import kineverse as kv

model = kv.load("kitchen")
scene = kv.geometry.Scene(model)
state = model.default_state().updated({"kitchen/fridge_door": 0.3})
scene.update(state)
for pair in scene.pairs_within(0.002):  # [m]
    print(pair)

scene.update(model.default_state())
pair = scene.distance("kitchen/fridge_door_handle", "kitchen/sink_area")
print(f"{pair.distance:.4f} m along {pair.normal.round(3)}")
hit = scene.ray(origin=(0, -1.6, 0.9), direction=(1, 0, 0))
print(hit.body, round(hit.distance, 3))

# The distance is an expression around the state: it has a gradient, and can be constrained.
gap = scene.expression("kitchen/fridge_door_handle", "kitchen/sink_area")
values = model.default_state() | kv.State(scene.expression_values(gap))
for speed, slope in gap.expression.gradient().items():
    print(speed, slope(values).round(4), "m/rad")
