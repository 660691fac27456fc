"""The arm of three links of the examples, in a plane, with a box and a door in its way."""

from markdown_examples import ROOT

ARM, SRDF = ROOT / "examples" / "arm.urdf", ROOT / "examples" / "arm.srdf"
MOVING = ("j0", "j1", "j2")
LEFT, RIGHT, INSIDE = [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]
