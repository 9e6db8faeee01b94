"""A pure-JAX ray caster: shaded images, depth and segmentation of primitives.

The layout makes it fast on a CPU. For an image, one unrolled expression folds over the
geoms and keeps two floats per pixel: the smallest depth, and the paint of that geom,
its color index plus its intensity. XLA compiles the fold to a single vectorized loop
over pixels that touches memory once, so no batch is too large for the caches.

The fold runs inside a ``lax.map`` over blocks of pixels because XLA does not fuse
across a loop. Otherwise it would fuse the fold into its users and cast the scene again
for each color channel; its CPU backend drops optimization barriers before it fuses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import functools

from flax import struct
import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, UInt8
import numpy as np

from apnpql_jax.render import intersect, shadow, texture
from apnpql_jax.render.appearance import FIELDS, Appearance, make_appearance
from apnpql_jax.render.geoms import CameraSpec, Geoms, Lighting
from apnpql_jax.types import Array

OUTPUTS = ("rgb", "depth", "segmentation")
DEFAULT_LIGHTING = Lighting()
NEAR = 0.005  # m
BLOCKS = 4  # of pixels per image; with one there would be no loop
_FULL = 255.0 / 256.0  # full intensity; below one, as the integer part is the color


class Image(struct.PyTreeNode):
  """Image of a camera; outputs that were not requested are ``None``."""

  rgb: UInt8[Array, "*b H W 3"] | None = None
  depth: Float[Array, "*b H W"] | None = None  # m along the viewing axis; inf: no hit
  segmentation: Int[Array, "*b H W"] | None = None  # MuJoCo geom ids; -1: no hit


@functools.partial(
  jax.jit, static_argnames=("geoms", "camera", "lighting", "outputs", "near")
)
def render(
  geoms: Geoms,
  camera: CameraSpec,
  geom_xpos: Float[Array, "*b ngeom 3"],
  geom_xmat: Float[Array, "*b ngeom 3 3"],
  cam_xpos: Float[Array, "*b 3"],
  cam_xmat: Float[Array, "*b 3 3"],
  lighting: Lighting = DEFAULT_LIGHTING,
  *,
  fields: Mapping[str, Array] | None = None,
  outputs: Sequence[str] = OUTPUTS,
  near: float = NEAR,
) -> Image:
  """Casts one ray per pixel through its center.

  Geoms are opaque. Back faces are not drawn, so a camera inside a geom sees through
  it, as in MuJoCo's renderer. Geoms hit closer than ``near`` (m) are not drawn either.
  Poses are in the world; ``fields`` are values per world of some ``appearance.FIELDS``.

  Raises:
    ValueError: An output is unknown, the shapes do not match, a shadow caster is not
      a drawn sphere, capsule or box, or a shadow receiver is not drawn.
  """
  if not outputs or not set(outputs) <= set(OUTPUTS):
    raise ValueError(f"outputs must be some of {OUTPUTS}, got {tuple(outputs)}")
  batch = cam_xpos.shape[:-1]
  poses = (geom_xpos, geom_xmat, cam_xpos, cam_xmat)
  tails = (geom_xpos.shape[-2:], (*geom_xpos.shape[-2:], 3), (3,), (3, 3))
  for pose, tail in zip(poses, tails, strict=True):
    if pose.shape != (*batch, *tail) or tail[-1] != 3:
      raise ValueError(f"shapes of the poses do not match: {[p.shape for p in poses]}")
  one = functools.partial(_render_one, geoms, camera, lighting, tuple(outputs), near)
  fields = {k: v for k, v in (fields or {}).items() if k in FIELDS}
  if not batch:
    return one(poses, fields)
  flat, fields = jax.tree.map(
    lambda x: x.reshape(-1, *x.shape[len(batch) :]), (poses, fields)
  )
  image = jax.vmap(one)(flat, fields)
  return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), image)


def _render_one(
  geoms: Geoms,
  camera: CameraSpec,
  lighting: Lighting,
  outputs: tuple[str, ...],
  near: float,
  poses: tuple[Array, Array, Array, Array],
  fields: Mapping[str, Array],
) -> Image:
  """Renders one image; see ``render`` for the arguments, here without leading axes."""
  geom_xpos, geom_xmat, cam_xpos, cam_xmat = poses
  to_camera = cam_xmat[None, :, :]
  center = ((geom_xpos[geoms.ids] - cam_xpos[None])[:, :, None] * to_camera).sum(axis=1)
  axes = (to_camera[..., None] * geom_xmat[geoms.ids][:, :, None, :]).sum(axis=1)
  look = make_appearance(geoms, camera, lighting, fields)
  basis = (look.light[:, :, None] * to_camera).sum(axis=1)
  frames = intersect.prepare(center, axes, look.sizes, basis[2])
  blocks = _blocks(camera, look.zoom)
  cast = functools.partial(_cast, geoms, lighting, look, frames, basis, near)
  t = paint = None
  # A loop for each: with two results XLA would split the fold.
  if "depth" in outputs or look.texture is not None:
    t = jax.lax.map(lambda rays: cast(rays)[0], blocks)
  if "rgb" in outputs or "segmentation" in outputs:
    paint = jax.lax.map(lambda rays: cast(rays)[1], blocks)
    if look.texture is not None:
      draw = functools.partial(texture.apply_texture, frames, look.texture, cam_xmat)
      paint = jax.lax.map(lambda block: draw(*block), (blocks, t, paint))
  return _make_image(geoms, camera, look.palette, outputs, t, paint)


def _blocks(camera: CameraSpec, zoom: Array | None) -> intersect.Rays:
  """Returns the rays f32[BLOCKS, P / BLOCKS]; the last block may be padded."""
  rays = intersect.make_rays(camera.height, camera.width, camera.fovy_deg)
  padding = -rays.u.size % BLOCKS
  rays = jax.tree.map(
    lambda x: jnp.asarray(np.pad(x, (0, padding), "edge").reshape(BLOCKS, -1)), rays
  )
  return rays if zoom is None else intersect.zoom_rays(rays, zoom)


def _make_image(
  geoms: Geoms,
  camera: CameraSpec,
  palette: Array | np.ndarray,
  outputs: tuple[str, ...],
  t: Array | None,
  paint: Array | None,
) -> Image:
  """Converts depth and paint of all blocks to the requested outputs."""
  shape = (camera.height, camera.width)
  pixels = camera.height * camera.width
  depth = rgb = segmentation = None
  if "depth" in outputs and t is not None:
    t = t.reshape(-1)[:pixels]
    depth = jnp.where(t < intersect.MISS, t, jnp.inf).reshape(shape)
  if paint is not None:
    paint = paint.reshape(-1)[:pixels]
    index = jnp.floor(paint)
    entry = index.astype(jnp.int32)
    if "rgb" in outputs:
      rgb = jnp.take(palette * np.float32(256.0), entry, axis=0, mode="clip")
      rgb = (rgb * (paint - index)[:, None]).astype(jnp.uint8).reshape(*shape, 3)
    if "segmentation" in outputs:
      ids = np.tile(np.append(geoms.ids, np.int32(-1)), 2)
      segmentation = jnp.take(ids, entry, mode="clip").reshape(shape)
  return Image(rgb=rgb, depth=depth, segmentation=segmentation)


def _cast(
  geoms: Geoms,
  lighting: Lighting,
  look: Appearance,
  frames: intersect.Frames,
  basis: Array,
  near: float,
  rays: intersect.Rays,
) -> tuple[Array, Array]:
  """Finds depth and paint f32[P] of every ray's first hit; ``MISS`` without one.

  The integer part of the paint is the palette's index, its fraction the intensity.
  """
  ray_light = intersect.along(basis[2], rays)
  t = jnp.full(rays.u.shape, intersect.MISS, jnp.float32)
  paint = jnp.full(rays.u.shape, nothing(geoms), jnp.float32)
  for k, kind in enumerate(geoms.types.tolist()):
    geom = intersect.row(frames, k)
    hit = intersect.HITS.get(kind)
    hit = hit or functools.partial(intersect.hull_hit, geoms.hulls[k])
    t_k, cosine = hit(geom, rays, ray_light)
    index = float(k)
    if look.texture is None and geoms.checker[k] > 0.0:
      edge = float(geoms.checker[k])
      x, y = intersect.plane_point(geom, rays, t_k)
      index = index + (len(geoms.ids) + 1) * texture.odd_square(x / edge, y / edge)
    closer = (t_k < t) & (t_k > near)
    t = jnp.where(closer, t_k, t)
    paint = jnp.where(closer, index + _intensity(lighting, look, cosine), paint)
  if lighting.shadow_casters:
    dark = jnp.zeros(t.shape, bool)
    for k in geoms.rows(lighting.shadow_casters, shadow.SHADOWS):
      darkens = shadow.SHADOWS[int(geoms.types[k])]
      dark = dark | darkens(intersect.row(frames, k), rays, t, basis)
    index = jnp.floor(paint)
    receives = jnp.zeros(t.shape, bool)
    for k in geoms.rows(lighting.shadow_receivers, intersect.HITS):
      receives = receives | (index == float(k))
      if geoms.checker[k] > 0.0:
        receives = receives | (index == float(k + len(geoms.ids) + 1))
    dimmed = index + (1.0 - lighting.shadow) * (paint - index)
    paint = jnp.where(dark & receives, dimmed, paint)
  return t, paint


def nothing(geoms: Geoms) -> float:
  """Returns the paint of rays that hit none of the geoms."""
  return len(geoms.ids) + _FULL


def _intensity(lighting: Lighting, look: Appearance, cosine: Array) -> Array:
  """Returns the intensity in [0, 255/256], by the formula of ``Lighting``."""
  lit = jnp.maximum(cosine, -lighting.fill * cosine)
  full = _FULL * (look.ambient + look.diffuse * lit)
  return jnp.minimum(full, _FULL)  # rounding may push a cosine above one
