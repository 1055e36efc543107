"""Measured shots: velocities before and after impacts with their errors, and their
files.
"""
