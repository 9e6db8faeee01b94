"""Calibration of both cameras with a printed board; see ``docs/calibration.md``.

``command.calibrate`` makes a calibration, ``files.load`` reads one. Poses are f64[4, 4]
and map coordinates of the named frame to those of the one that it is in, in m. Optical
frames have x right, y down and z forward, as in OpenCV.
"""
