"""Load a model and show it in the browser, with a slider for each joint.

With ``--headless`` it writes the picture kitchen.png instead, which needs neither a browser nor a display.
"""

import sys

import kineverse as kv
from kineverse.view import save_picture

model = kv.load("kitchen")  # the name of a model that ships, or the path of a .urdf, .sdf, .xml or .kv.json
print(model)
for symbol in model.degrees_of_freedom[:3]:
    print(symbol, model.limits(symbol))  # [rad], [m]

state = {"kitchen/fridge_door": 0.8, "kitchen/oven_left_drawer": 0.3}
if "--headless" in sys.argv:
    save_picture("kitchen.png", model, state)
else:
    kv.show(model, state)  # until Ctrl-C
