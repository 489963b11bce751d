# SPDX-License-Identifier: Apache-2.0
"""Short cycles and a small problem."""

from study_fixtures import hill, small_grid, small_policy

__all__ = ["hill", "small_grid", "small_policy"]
