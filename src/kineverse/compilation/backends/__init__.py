"""Functions of expressions for libraries that differentiate: JAX and PyTorch."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .jax import to_jax as to_jax
    from .torch import to_torch as to_torch

lazy_face(__name__)
