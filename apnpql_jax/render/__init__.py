"""Images of scenes made of primitives: a pure-JAX ray caster."""

from apnpql_jax.render.geoms import CameraSpec, Geoms, Lighting
from apnpql_jax.render.raycast import Image, render

__all__ = ["CameraSpec", "Geoms", "Image", "Lighting", "render"]
