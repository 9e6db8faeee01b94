"""Drivers of real devices; each needs the vendor's package."""
