"""Numerical methods: derivatives, steps, complementarity, friction, linear systems."""
