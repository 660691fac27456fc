"""Model a finger of three phalanges that one tendon pulls: its joints share the tendon's travel.

The tendon runs over a pulley of radius rₖ at each joint, and springs of stiffness cₖ stretch the finger.
Under a tension T the joints are at rest at qₖ = T rₖ/cₖ, and the tendon has travelled s = Σ rₖ qₖ. Therefore
qₖ = s (rₖ/cₖ) / Σ rⱼ²/cⱼ.
"""

import kineverse as kv

radii, stiffnesses, lengths = (0.012, 0.009, 0.007), (0.10, 0.06, 0.05), (0.045, 0.030, 0.025)
s = kv.position("finger/tendon")  # travel [m]
compliance = sum(r * r / c for r, c in zip(radii, stiffnesses, strict=True))

model, parent = kv.Model(), "world"
with model.edit() as edit:
    for k, (r, c, length) in enumerate(zip(radii, stiffnesses, lengths, strict=True)):
        q, name = s * (r / c) / compliance, f"finger/joint_{k}"
        edit.apply(kv.Revolute(name=name, parent=parent, child=name, axis=(0, 1, 0), position=q, upper=1.6))
        parent = f"finger/phalanx_{k}"
        edit.add_frame(parent, parent=name, transform=kv.translation(length, 0, 0))

print(model.degrees_of_freedom)
for travel in (0.0, 0.015, 0.03):
    tip, slope = model.fk(parent)({s: travel})[:3, 3], model.jacobian(parent)({s: travel})[:3, 0]
    print(travel, tip.round(4), slope.round(2))
print(model.violations({s: 0.042}))  # the joint that reaches its limit first
