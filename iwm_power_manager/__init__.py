# SPDX-License-Identifier: Apache-2.0
"""Stochastic power management for cars with in-wheel motors."""

__version__ = "0.2.0"
