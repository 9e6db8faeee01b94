"""Command line: a module per command, with its options and its function.

JAX, MuJoCo and the modules that need them are imported inside the functions, so that
help and errors are fast.
"""
