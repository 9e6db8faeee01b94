"""Images of primitive scenes: a pure-JAX ray caster and the writing of videos."""

from apnpql_jax.render.geoms import CameraSpec, Geoms, Lighting
from apnpql_jax.render.raycast import Image, render

__all__ = ["CameraSpec", "Geoms", "Image", "Lighting", "render"]
