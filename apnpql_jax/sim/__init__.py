"""Physics on top of MuJoCo: scenes, engines and kinematics; no learning code.

The package itself imports no JAX, so that the runtime of a real arm can use ``motors``
and ``names``.
"""
