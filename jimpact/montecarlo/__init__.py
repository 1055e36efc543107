"""The parts of `monte_carlo`: distributions, chunks of samples, their statistics, their
files.
"""
