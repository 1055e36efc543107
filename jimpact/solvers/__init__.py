"""Solvers of contact problems: complementarity, friction, linear systems."""
