"""Stochastic power management for cars with in-wheel motors."""

__version__ = "0.2.0"
