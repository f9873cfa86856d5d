"""Calibrations: their file, the correction of data by them, and their exports to other programs.

    Estimate -> file -> equation -> correction: log -> log
                                 -> exports: text of flight_controllers | c_header | a template, with its losses

The kinds of channel are alike: a gyro axis is a calibration with one channel.
"""
