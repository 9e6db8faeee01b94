"""Settings, their checks and their files; imports neither JAX nor MuJoCo."""
