"""Objects of a user's scene that change size, shape and mass, against MuJoCo."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

from hand_made import randomized
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from apnpql_jax.config.ranges import RandomizationConfig
from apnpql_jax.errors import ConfigError
from apnpql_jax.randomization.randomize import make_randomize
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene, compile_file, load_scene

NONE = RandomizationConfig(
  **{field.name: 0.0 for field in dataclasses.fields(RandomizationConfig)}
)
SIZES = dataclasses.replace(NONE, size=0.05, shape=0.1)
ALL = dataclasses.replace(SIZES, mass=0.3)
THINGS = {
  "ball": '<geom type="sphere" size="0.03" mass="0.1"/>',
  "can": '<geom type="cylinder" size="0.03 0.05" mass="0.1"/>',
  "pill": '<geom type="capsule" size="0.02 0.05" mass="0.1"/>',
  "egg": '<geom type="ellipsoid" size="0.02 0.03 0.05" mass="0.1"/>',
  "angle": """<geom name="angle" type="box" size="0.05 0.01 0.02" mass="0.1"/>
    <geom name="leg" type="box" size="0.01 0.04 0.02" pos="0.04 0.05 0" mass="0.1"/>""",
}
"""Objects by name. The principal axes of the last are not those of its body."""

HEIGHT = 0.3  # m


def scene_of(folder: Path, things: dict[str, str], assets: str = "") -> Scene:
  """Loads a scene with objects over a shelf; only the first geom of each collides."""
  text, pairs, qpos = "", "", "0 -1.5 1.5 -1.5 -1.5 0 0 0 0 0"
  for name, geoms in things.items():
    geoms = geoms.replace("<geom ", f'<geom name="{name}" ', "name=" not in geoms)
    text += f'<body name="{name}"><freejoint/>{geoms}</body>'
    pairs += f'<pair geom1="shelf" geom2="{name}"/>'
    qpos += " 0.5 0 1 1 0 0 0" + " 0" * geoms.count("<joint ")
  path = folder / "mine.xml"
  path.write_text(f"""<mujoco><include file="arena.xml"/><asset>{assets}</asset>
    <worldbody>{text}
      <geom name="shelf" type="plane" size="1 1 1" pos="0 0 {HEIGHT}"/>
    </worldbody><contact>{pairs}</contact>
    <keyframe><key name="neutral" qpos="{qpos}"/></keyframe></mujoco>""")
  return load_scene(path)


def gaps(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
  """Returns the distances of the objects from the shelf, by C MuJoCo, f64[objects]."""
  data = mujoco.MjData(model)
  data.qpos[:] = qpos
  mujoco.mj_kinematics(model, data)
  shelf = model.geom("shelf").id
  return np.array(
    [
      mujoco.mj_geomDistance(model, data, shelf, model.geom(name).id, 9.0, None)
      for name in THINGS
    ]
  )


def world(scene: Scene, state: PhysicsState, index: int) -> mujoco.MjModel:
  """Returns the model of a world, without the constants that MuJoCo derives."""
  model = copy.copy(scene.model)
  for field in "body_mass body_inertia body_ipos geom_size geom_pos".split():
    getattr(model, field)[:] = np.asarray(state.fields[field][index])
  return model


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
  return scene_of(tmp_path_factory.mktemp("shelf"), THINGS)


@pytest.fixture(scope="module")
def state(scene) -> PhysicsState:
  """Returns worlds whose objects touch the shelf, in any orientation."""
  qpos = np.tile(scene.keyframe("neutral"), (8, 1))
  turns = Rotation.random(8 * len(THINGS), rng=0).as_quat(scalar_first=True)
  places = qpos[:, 10:].reshape(8, -1, 7)
  places[..., 3:] = turns.reshape(8, -1, 4)
  for row in range(8):
    places[row, :, 2] -= gaps(scene.model, qpos[row])
  return randomized(scene, ALL, qpos)


def test_objects_of_any_size_stand_where_they_stood(scene, state):
  for index in range(8):
    distance = gaps(world(scene, state, index), np.asarray(state.qpos[index]))
    np.testing.assert_allclose(distance, 0.0, atol=1e-5)
  boxes = state.fields["geom_size"][:, scene.id("geom", "angle")]
  assert np.ptp(np.asarray(boxes), axis=0).min() > 0.0005


def test_inertias_are_those_of_a_scene_with_these_sizes(tmp_path, scene, state):
  """Of the bodies whose geoms are boxes, whose scaled mass MuJoCo integrates."""
  body = scene.id("body", "angle")
  assert Rotation.from_quat(scene.model.body_iquat[body], scalar_first=True).magnitude()
  for index in range(8):
    sizes, places = (
      np.asarray(state.fields[f"geom_{kind}"][index], float) for kind in ("size", "pos")
    )
    mass = float(state.fields["body_mass"][index, body]) / scene.model.body_mass[body]

    def edit(spec: mujoco.MjSpec, sizes=sizes, places=places, mass=mass) -> None:
      for name in ("angle", "leg"):
        geom, row = spec.geom(name), scene.id("geom", name)
        geom.size, geom.pos, geom.mass = sizes[row], places[row], 0.1 * mass

    expected = tensor(compile_file(scene.path, edit), body)
    found = tensor(world(scene, state, index), body)
    np.testing.assert_allclose(found, expected, atol=1e-5 * expected.max())


def tensor(model: mujoco.MjModel, body: int) -> np.ndarray:
  """Returns the inertia of a body about the axes of its frame, f64[3, 3]."""
  turn = Rotation.from_quat(model.body_iquat[body], scalar_first=True).as_matrix()
  return turn @ np.diag(model.body_inertia[body]) @ turn.T


def test_derived_constants_are_those_of_mujoco(scene, state):
  for index in range(8):
    model = world(scene, state, index)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for field in "body_subtreemass body_invweight0 dof_invweight0 dof_M0".split():
      np.testing.assert_allclose(
        state.fields[field][index], getattr(model, field), rtol=2e-4, err_msg=field
      )


ROCK = '<mesh name="rock" vertex="0 0 0  0.05 0 0  0 0.05 0  0 0 0.05"/>'
MESH = {"stone": '<geom type="mesh" mesh="rock" mass="0.1"/>'}
LID = {
  "box": """<geom name="box" type="box" size="0.05 0.05 0.05" mass="0.1"/>
    <body name="lid"><joint type="hinge"/><geom size="0.02" mass="0.1"/></body>"""
}


@pytest.mark.parametrize(
  ("things", "ranges", "message"),
  [
    (
      MESH,
      {"size": 0.05},
      "mine.xml: body 'stone' has a mesh, .*size and .shape",
    ),
    (MESH, {"shape": 0.05}, "body 'stone' has a mesh"),
    (MESH, {"mass": 0.05, "friction": 0.1}, None),
    (
      LID,
      {"size": 0.05},
      "mine.xml: body 'box' carries body 'lid', .*size, .sh",
    ),
    (LID, {"mass": 0.05}, "body 'box' carries body 'lid'"),
    (LID, {"color": 0.1, "friction": 0.1}, None),
  ],
)
def test_what_cannot_change_is_refused_by_name(tmp_path, things, ranges, message):
  scene = scene_of(tmp_path, things, assets=ROCK)
  config = dataclasses.replace(NONE, **ranges)
  if message is None:
    make_randomize(config, scene)
    return
  with pytest.raises(ConfigError, match=message):
    make_randomize(config, scene)
