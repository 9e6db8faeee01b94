"""Checks of the installation and the machine, which never raise."""
