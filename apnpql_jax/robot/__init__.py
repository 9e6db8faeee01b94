"""The runtime of a real arm: drivers, safety limits, calibration and logs."""
