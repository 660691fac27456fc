"""Learn where the hinge of a door is, and how it leans, by gradient descent in JAX."""

import numpy as np

import kineverse as kv

try:
    import jax
    import jax.numpy as jnp
except ImportError:
    print("This example needs JAX, which is the extra 'jax': pip install -e '.[jax]'")
    raise SystemExit from None

door = kv.position("door")
x, y, roll, pitch = hinge = [kv.parameter(name, 0.0) for name in ("x", "y", "roll", "pitch")]
pose = kv.translation(x, y, 0) @ kv.rpy(roll, pitch, 0) @ kv.rotation_z(door)
marks = np.array([[0.1, 0, 0.2, 1], [0.7, 0, 0.2, 1], [0.7, 0, 1.8, 1], [0.1, 0, 1.8, 1]])  # on the door
points = kv.to_jax((pose @ marks.T).T[:, :3], [door, *hinge])

# What a camera sees of a door that opens: four points, 30 times, with noise of 3 mm. It sees no angles.
rng = np.random.default_rng(0)
truth = np.array([0.3, -0.2, np.radians(1.5), np.radians(-2.0)])
angles = np.linspace(0.1, 1.4, 30)
seen = points(np.column_stack([angles, np.tile(truth, (30, 1))])) + rng.normal(0, 0.003, (30, 4, 3))


def loss(unknown):
    """Return the mean square distance between the points and where they are seen, in mm²."""
    hinges = jnp.broadcast_to(unknown["hinge"], (30, 4))
    found = points(jnp.concatenate([unknown["angles"][:, None], hinges], axis=1))
    return 1e6 * jnp.mean(jnp.sum((found - seen) ** 2, axis=-1))


STEPS = {"hinge": 4e-8, "angles": 4e-7}  # an angle moves the points of one picture, the hinge those of all


@jax.jit
def descend(unknown, momentum):
    """Make one step of gradient descent with momentum."""
    value, gradient = jax.value_and_grad(loss)(unknown)
    momentum = {name: 0.9 * momentum[name] + gradient[name] for name in unknown}
    return value, {name: unknown[name] - STEPS[name] * momentum[name] for name in unknown}, momentum


unknown = {"hinge": jnp.zeros(4), "angles": jnp.full(30, 0.5)}
momentum = {name: jnp.zeros_like(values) for name, values in unknown.items()}
for _ in range(1000):
    value, unknown, momentum = descend(unknown, momentum)
found = np.asarray(unknown["hinge"])
print(f"{float(value) ** 0.5:.1f} mm between seen and computed points")
for name, one, true in zip(("x", "y"), found[:2], truth[:2], strict=True):
    print(f"{name} = {1e3 * one:.0f} mm, in truth {1e3 * true:.0f} mm")
for name, one, true in zip(("roll", "pitch"), np.degrees(found[2:]), np.degrees(truth[2:]), strict=True):
    print(f"{name} = {one:.1f}°, in truth {true:.1f}°")
